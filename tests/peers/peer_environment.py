"""The environment of the programs that this project is held against: rl_zoo3 and what it needs.

It is apart from the project's own, since moviepy, which rl_zoo3 needs, keeps Pillow at a version
with known holes. It lies inside the environment of the Python that runs this, and sees the packages
there behind its own, so that PyTorch is not installed twice. Tests make it when they first need it:

    python tests/peers/peer_environment.py      # makes it now
"""

import fcntl
import hashlib
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

REQUIREMENTS = Path(__file__).with_name("requirements.txt")
FOLDER = Path(sys.prefix) / "peers"
PYTHON = FOLDER / "bin" / "python"
PACKAGES = Path(sysconfig.get_path("purelib", "venv", {"base": str(FOLDER)}))
# Written last, with the digest of the requirements that were installed.
STAMP = FOLDER / "installed"


def peer_python() -> str:
    """The interpreter that finds the peers; not an import here: rl_zoo3's changes Gymnasium."""
    _make_once()
    return str(PYTHON)


def peer_folder(package: str) -> Path:
    """Where the files of a peer lie, for those that are read without being run."""
    _make_once()
    return PACKAGES / package


def _make_once() -> None:
    """Make the environment, unless it is there; of several processes one does, and all wait."""
    digest = hashlib.sha256(REQUIREMENTS.read_bytes()).hexdigest()
    if _is_made(digest):
        return
    if sys.prefix == sys.base_prefix:
        raise RuntimeError("the peers are installed inside a virtual environment, and this is none")
    with FOLDER.with_name("peers.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not _is_made(digest):
            _make()
            STAMP.write_text(digest)


def _is_made(digest: str) -> bool:
    return STAMP.exists() and STAMP.read_text() == digest


def _make() -> None:
    shutil.rmtree(FOLDER, ignore_errors=True)
    venv.create(FOLDER, symlinks=True)
    _pip("install", "--no-deps", "--require-hashes", "-r", str(REQUIREMENTS))
    # Lines here come behind the folder that they lie in: what is installed there is found first.
    (PACKAGES / "behind.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    _pip("check")


def _pip(*words: str) -> None:
    """Run the pip of this environment on that of the peers."""
    command = [sys.executable, "-m", "pip", "--python", str(PYTHON), "--quiet", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"the peers cannot be installed:\n{done.stdout}{done.stderr}")


if __name__ == "__main__":
    print(peer_python())
