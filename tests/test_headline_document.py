"""What README and the report say of the headline study is put there by a program."""

import importlib.util
from pathlib import Path

import train

SCRIPT = Path(train.__file__).parent / "benchmarks" / "headline.py"
spec = importlib.util.spec_from_file_location("headline_script", SCRIPT)
headline = importlib.util.module_from_spec(spec)
spec.loader.exec_module(headline)


def test_blocks_are_replaced_and_the_others_stay():
    page = (
        "a\n<!-- headline: tuned -->\nold\n<!-- end -->\nb\n"
        "<!-- headline: what-fell -->\nkept\n<!-- end -->\n"
    )
    once = headline.filled(page, {"tuned": "| new \\1 |\n\nlegend\n"})
    assert once == page.replace("old", "| new \\1 |\n\nlegend")
    assert headline.filled(once, {"tuned": "old"}) == page


def test_the_pages_have_the_blocks_that_it_fills():
    found = {path.name: set() for path in headline.PAGES}
    for path in headline.PAGES:
        for block in headline.BLOCK.finditer(path.read_text(encoding="utf-8")):
            found[path.name].add(block[2])
    assert found == {
        "README.md": {"held-out"},
        "library-vs-hand-rolled.md": {"held-out", "tuned", "what-fell", "verdicts-held-out"},
    }
