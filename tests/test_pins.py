"""What is installed is what is pinned; its files are known by hash, its known holes are mended."""

import importlib.metadata
import re
import sys
import tomllib
from pathlib import Path

import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests.peers.peer_environment import peer_folder

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
HASH = re.compile(r"--hash=sha256:[0-9a-f]{64}")

MENDED = yaml.safe_load((ROOT / "tests" / "mended.yml").read_text(encoding="utf-8"))


def entries(file):
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


def pins(file):
    """The version that a file pins for each name, on whatever system."""
    return {name: version_of(requirement) for name, (requirement, _) in entries(file).items()}


def version_of(requirement):
    (specifier,) = requirement.specifier
    assert specifier.operator == "=="
    return Version(specifier.version)


def unmet(requirements, versions):
    """The requirements that are not there in a version that meets them."""
    found = {str(one): versions.get(canonicalize_name(one.name)) for one in requirements}
    return [
        f"{one}: {version}"
        for one, version in found.items()
        if version is None or not Requirement(one).specifier.contains(version, prereleases=True)
    ]


def requirements_in(lines):
    return [Requirement(line) for line in lines if not line.startswith("#")]


def test_a_version_inside_each_declared_range_is_pinned():
    extras = PROJECT["optional-dependencies"].values()
    declared = requirements_in(sum(extras, PROJECT["dependencies"]))
    pinned = pins("constraints.txt")
    assert unmet([one for one in declared if one.name != PROJECT["name"]], pinned) == []
    theirs = (ROOT / "tests/peers/requirements.in").read_text().splitlines()
    assert unmet(requirements_in(theirs), pinned | pins("tests/peers/requirements.txt")) == []


def test_all_but_pytorch_have_hashes():
    pinned, hashed = entries("constraints.txt"), entries("requirements.txt")
    del pinned["torch"]
    assert [str(one) for one, _ in hashed.values()] == [str(one) for one, _ in pinned.values()]
    for found in (hashed, entries("tests/peers/requirements.txt")):
        counts = {name: count for name, (_, count) in found.items()}
        assert min(counts.values()) >= 1
        # Those of all systems and Pythons, not of one wheel.
        assert counts["pillow"] > 20


def test_what_is_pinned_is_installed():
    for file, path in (
        ("constraints.txt", sys.path),
        ("tests/peers/requirements.txt", [str(peer_folder("."))]),
    ):
        found = importlib.metadata.distributions(path=list(path))
        packages = {canonicalize_name(package.name): package for package in found}
        # A build of PyTorch has a label behind its version, such as +cpu.
        versions = {name: Version(package.version).public for name, package in packages.items()}
        for name, (requirement, _) in entries(file).items():
            if requirement.marker is None or requirement.marker.evaluate():
                assert versions.get(name) == version_of(requirement).public, name
        # The peers would hold back what users get.
        assert ("rl-zoo3" in versions) == ("peers" in file)


def test_known_holes_are_mended_but_for_one_of_the_peers():
    """That is why the peers are apart; once this fails, they need not be."""
    pinned, theirs = pins("constraints.txt"), pins("tests/peers/requirements.txt")
    assert MENDED.keys() <= pinned.keys()
    assert {name for name, (mended, _) in MENDED.items() if pinned[name] < Version(mended)} == set()
    assert pinned.keys() & theirs.keys() == {"pillow"}
    assert theirs["pillow"] < Version(MENDED["pillow"][0])
