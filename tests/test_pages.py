"""Pages are filled by programs with what follows from code and runs, and have one form."""

import importlib
import re
import sys
from pathlib import Path

import pytest

from rl_yardstick.agents import ALGORITHMS

DOCS = Path(__file__).resolve().parents[1] / "docs"
FORM = ["Idea", "Update", "Code", "Example", "Limitations", "Run", "Source"]


@pytest.fixture(scope="module")
def fill_pages():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [str(DOCS / "_ext"), str(DOCS / "scripts"), *sys.path])
        yield importlib.import_module("fill_pages")


@pytest.fixture(scope="module")
def fill_tables(fill_pages):
    return importlib.import_module("fill_tables")


def test_pages_can_be_filled(fill_pages, fill_tables):
    """`make docs` checks the dear tables too, in seconds to a minute."""
    dear = {"environments.md", "jacks-car-rental.md"}
    dear |= {"hallway.md", "racetrack.md", "dark-warehouse.md"}
    for path in sorted(path for path in DOCS.rglob("*.md") if path.name not in dear):
        text = path.read_text()
        assert fill_tables.filled(text, outputs=False) == text, path
        text = fill_pages.filled(text, path.parent)
        assert not re.search(r"^\[[^\]]*\]\(\S+ \"[^\"]*\"\)$", text, re.MULTILINE), path


def test_every_environment_is_pictured(fill_tables):
    drawn = {path.stem for path in (DOCS / "images" / "environments").glob("*.png")}
    assert drawn == {env_id for env_id, *_ in fill_tables.requested("facts")}


def test_the_table_of_hardness_has_each_environment_with_a_model(fill_tables):
    own = {item.partition("=")[2] for items in fill_tables.requested("optima") for item in items}
    (listed,) = fill_tables.requested("hardness")
    without = {"GaussianBandit-v0", "LinearBandit-v0"}
    assert own - without < set(listed)
    assert not without & set(listed)
    text = fill_tables.filled("<!-- hardness: DeepSea-v0 -->\n<!-- end -->")
    _, heads, _, row, _ = text.splitlines()
    worth = "55 of 101 | 9 | 0.001 | 1 | 10 | 10,240 | 10,240"
    assert row == f"| `DeepSea-v0` | {worth} |"
    assert heads.count("|") == row.count("|")


def test_a_block_is_filled_and_others_stay(fill_pages, fill_tables):
    with pytest.raises(ValueError, match=r"mdp/graph\.py defines no nothing"):
        fill_pages.filled('[x](../rl_yardstick/mdp/graph.py "code: nothing")', DOCS)
    other = 'See [code](x.py "code: f") and [a title](x.md "agents of ours").\n'
    assert fill_pages.filled(other, DOCS) == other
    filled = fill_tables.filled(f"{other}<!-- agents -->\n<!-- end -->\n")
    assert filled.startswith(other)
    assert all(f"`{name}`" in filled for name in ALGORITHMS)


@pytest.mark.parametrize("page", sorted((DOCS / "algorithms").glob("*.md")), ids=lambda p: p.stem)
def test_pages_of_algorithms_have_one_form(page):
    text = page.read_text()
    assert page.stem in ALGORITHMS
    assert re.match(rf"# .*\(`{page.stem}`\)\n", text)
    assert re.findall(r"^## (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.M) == FORM
    for file, name in re.findall(r"`(test_\w+)` in `(tests/[\w/]+\.py)`", text):
        assert f"def {file}(" in (DOCS.parent / name).read_text()


def test_every_page_of_an_environment_says_who_finds_it_hard():
    for page in (DOCS / "environments").glob("*-*.md"):
        assert "\n## Who finds it hard\n" in page.read_text(), page.name
