"""What is installed is what is pinned; its files are known by hash, its known holes are mended."""

import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests.peers.peer_environment import peer_folder, peer_python

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
HASH = re.compile(r"--hash=sha256:[0-9a-f]{64}")

# The first versions without the holes named, each as the project's own change notes say. They were
# read in copies of summer 2026: what became known later, or stands in no change notes, is missing.
MENDED = {
    "fonttools": ("4.61.0", "CVE-2025-66034"),
    "h11": ("0.16.0", "GHSA-vqfr-h8mv-ghfj"),
    "jinja2": ("3.1.6", "GHSA-cpwx-vrp4-4pq7"),
    # Also, in 12.2.0, CVE-2026-40192 and CVE-2026-42308 to -42311; in 12.1.1, CVE-2026-25990.
    "pillow": ("12.3.0", "CVE-2026-59197 CVE-2026-59199 CVE-2026-59204 CVE-2026-59205"),
    "pyyaml": ("5.4", "CVE-2020-14343"),
    "setuptools": ("83.0.0", "GHSA-h35f-9h28-mq5c"),
    "urllib3": ("2.7.0", "GHSA-mf9v-mfxr-j63j GHSA-qccp-gfcp-xxvc"),
    "werkzeug": ("3.1.6", "GHSA-29vq-49wr-vm6x"),
}


def entries(file: str) -> dict[str, tuple[Requirement, int]]:
    """The requirements of a file by their names, each with the number of its hashes."""
    lines = (ROOT / file).read_text().replace("\\\n", " ").splitlines()
    found = {}
    for line in lines:
        if not line.startswith("#"):
            requirement = Requirement(HASH.sub("", line))
            name = canonicalize_name(requirement.name)
            assert name not in found, f"{name} is pinned twice in {file}"
            found[name] = (requirement, len(HASH.findall(line)))
    return found


def pins(file: str) -> dict[str, Version]:
    """The version that a file pins for each name, on whatever system."""
    return {name: version_of(requirement) for name, (requirement, _) in entries(file).items()}


def version_of(requirement: Requirement) -> Version:
    (specifier,) = requirement.specifier
    assert specifier.operator == "=="
    return Version(specifier.version)


def differences(file: str, *path: str) -> dict[str, str]:
    """What is installed otherwise than a file says that it is on this system."""
    installed = {
        canonicalize_name(one.name): Version(one.version)
        for one in importlib.metadata.distributions(path=list(path or sys.path))
    }
    return {
        name: f"{installed.get(name)}, not {version_of(requirement)}"
        for name, (requirement, _) in entries(file).items()
        if requirement.marker is None or requirement.marker.evaluate()
        # A build of PyTorch has a label behind its version, such as +cpu.
        if name not in installed or installed[name].public != version_of(requirement).public
    }


def test_a_version_inside_each_declared_range_is_pinned() -> None:
    pinned = pins("constraints.txt")
    extras = PROJECT["optional-dependencies"].values()
    declared = [Requirement(line) for lines in (PROJECT["dependencies"], *extras) for line in lines]
    others = [one for one in declared if one.name != PROJECT["name"]]
    assert [
        str(one) for one in others if pinned[canonicalize_name(one.name)] not in one.specifier
    ] == []
    assert all(version.local is None for version in pinned.values())


def test_the_hashes_are_of_the_pinned_versions_of_all_but_pytorch() -> None:
    def lines(file: str) -> dict[str, str]:
        return {name: str(requirement) for name, (requirement, _) in entries(file).items()}

    pinned = lines("constraints.txt")
    del pinned["torch"]
    assert lines("requirements.txt") == pinned


@pytest.mark.parametrize("file", ["requirements.txt", "tests/peers/requirements.txt"])
def test_everything_has_hashes(file: str) -> None:
    counts = {name: count for name, (_, count) in entries(file).items()}
    assert min(counts.values()) >= 1
    # Those of all systems and Pythons, not of one wheel.
    assert counts["pillow"] > 20


def test_what_is_pinned_is_installed() -> None:
    assert differences("constraints.txt") == {}
    assert differences("tests/peers/requirements.txt", str(peer_folder("."))) == {}


def test_no_peer_is_installed_beside_the_project() -> None:
    """It would hold back what users get; they install the same as the tests, but for the peers."""
    assert not {"rl-zoo3", "moviepy"} & pins("constraints.txt").keys()
    for name in ("rl-zoo3", "moviepy"):
        with pytest.raises(importlib.metadata.PackageNotFoundError):
            importlib.metadata.version(name)


def test_the_peers_environment_has_only_what_differs() -> None:
    shared = pins("constraints.txt")
    theirs = pins("tests/peers/requirements.txt")
    assert {name for name in theirs if name in shared} == {"pillow"}
    assert theirs["pillow"] < shared["pillow"]
    declared = [
        Requirement(line)
        for line in (ROOT / "tests/peers/requirements.in").read_text().splitlines()
        if not line.startswith("#")
    ]
    both = shared | theirs
    assert [
        str(one) for one in declared if both[canonicalize_name(one.name)] not in one.specifier
    ] == []


def test_both_environments_are_complete_and_agree() -> None:
    for python in (sys.executable, peer_python()):
        words = [sys.executable, "-m", "pip", "--python", python, "check"]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout


def test_known_holes_are_mended() -> None:
    pinned = pins("constraints.txt")
    assert MENDED.keys() <= pinned.keys()
    old = {name for name, (mended, _) in MENDED.items() if pinned[name] < Version(mended)}
    assert old == set()
    assert all(
        re.fullmatch(r"(CVE-\d{4}-\d+|GHSA(-\w{4}){3}| )+", ids) for _, ids in MENDED.values()
    )


def test_the_peers_alone_have_a_known_hole() -> None:
    """That is why they are apart; once this fails, they need not be."""
    theirs = pins("tests/peers/requirements.txt")
    old = {name for name in theirs if name in MENDED and theirs[name] < Version(MENDED[name][0])}
    assert old == {"pillow"}
