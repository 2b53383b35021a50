"""Checks the English of pages and of printed lines: ``python docs/scripts/english.py``.

Fails on constructions that readers stumbled over (`BANNED`), in README, docs and the strings of the
package; and, on the pages that everybody reads first, on sentences of over 30 words and on a Flesch
reading ease below 55. With ``--pages`` it prints the reading ease of every page. (Flesch, *A new
readability yardstick*, 1948: 206.835 - 1.015 words per sentence - 84.6 syllables per word.)
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FIRST_PAGES = ("README.md", "docs/start.md", "docs/compare.md")
LONGEST = 30  # words of a sentence there
EASE = 55  # at least, there
# Each with a better way to put it.
BANNED = {
    r"\bso that\b": "two sentences, or 'to ...'",
    r"\bthere (?:is|are|was|were) [^.:;?]{1,60}\b(?:that|which|who)\b": "name the subject first",
    r"(?:^|(?<=[.:] ))What\b[^.?]*[.:]": "the noun of the field",
    r"\bwhat (?:it|they|he|she|each|comes|counts|follows|remains|happens)\b[^.?]*\.": "the noun",
    r"\b(?:go|goes|going|went) on\b": "continue, resume",
    r"\bas (?:it|they) comes?\b": "unmodified",
    r"\bsays? whether\b": "test, check",
    r"\bshown to be\b": "beat, no setting beat",
    r"\ba matter of\b": "can only be set in",
    r"\b(?:nobody|everybody)\b": "no one in the text: name who",
    r"\bwithout playing\b": "no episodes sampled",
    r"\bso far has\b": "has the highest",
}
PATTERNS = [(re.compile(key, re.IGNORECASE | re.MULTILINE), told) for key, told in BANNED.items()]


def prose(page: str) -> str:
    """The sentences of a page in Markdown, without code, tables, formulas and comments."""
    for unread in (
        r"(?ms)^(```|~~~|:::).*?^\1",
        r"(?s)<!--.*?-->",
        r"(?s)\$\$.*?\$\$",
        r"(?m)^\|.*$",
    ):
        page = re.sub(unread, "\n", page)
    page = re.sub(r"!\[[^\]]*\]\([^)]*\)|<[^>]+>", "", page)
    page = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", page)
    page = re.sub(r"`[^`]*`|\$[^$]*\$", "x", page)
    page = re.sub(r"(?m)^(?:#+ .*|\s*(?:[-*]|\d+\.) )", "\n", page)
    paragraphs = (" ".join(part.split()) for part in re.split(r"\n\s*\n", page))
    return "\n".join(re.sub(r"[*_]{1,2}", "", part) for part in paragraphs if part)


def sentences(text: str) -> list[list[str]]:
    """The words of each sentence; numbers and names in code count as one word."""
    parts = re.split(r"(?<=[.!?:;])[)\"]?\s+|\n", text)
    found = ([word for word in part.split() if re.search(r"\w", word)] for part in parts)
    return [words for words in found if words]


def reading_ease(text: str) -> float:
    """Flesch's reading ease: 60 to 70 is plain English."""
    found = sentences(text)
    words = [word for sentence in found for word in sentence]
    syllables = sum(_syllables(word) for word in words)
    return 206.835 - 1.015 * len(words) / len(found) - 84.6 * syllables / len(words)


def _syllables(word: str) -> int:
    """An estimate: groups of vowels, without a silent e."""
    word = re.sub(r"[^a-z]", "", word.lower())
    silent = re.sub(r"(?:[^laeiouy]es|[^aeiouytd]ed|[^laeiouy]e)$", "", word)
    return max(1, len(re.findall(r"[aeiouy]+", silent)))


def printed(path: Path) -> Iterator[tuple[int, str]]:
    """The strings of a module with several words, without docstrings; with their lines."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, documented) and node.body and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if is_text and id(node) not in docstrings and node.value.count(" ") > 1:
            yield node.lineno, node.value


def faults() -> Iterator[str]:
    """A line for each construction that is banned, and each first page that is hard to read."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    for path in pages:
        name = path.relative_to(ROOT).as_posix()
        text = prose(path.read_text(encoding="utf-8"))
        for pattern, better in PATTERNS:
            yield from (f"{name}: '{found[0]}': {better}" for found in pattern.finditer(text))
        if name in FIRST_PAGES:
            for words in sentences(text):
                if len(words) > LONGEST:
                    yield f"{name}: a sentence of {len(words)} words: {' '.join(words[:8])} ..."
            if (ease := reading_ease(text)) < EASE:
                yield f"{name}: a reading ease of {ease:.0f}, not {EASE}"
    for path in sorted((ROOT / "rl_yardstick").rglob("*.py")):
        for line, text in printed(path):
            for pattern, better in PATTERNS:
                if found := pattern.search(text):
                    yield f"{path.relative_to(ROOT)}:{line}: '{found[0]}': {better}"


def main() -> None:
    """Print the faults, or the reading ease of each page."""
    if "--pages" in sys.argv:
        for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
            text = prose(path.read_text(encoding="utf-8"))
            if sentences(text):
                print(f"{reading_ease(text):5.0f}  {path.relative_to(ROOT)}")
        return
    found = list(faults())
    print("\n".join(found))
    sys.exit(f"{len(found)} sentences to put better" if found else 0)


if __name__ == "__main__":
    main()
