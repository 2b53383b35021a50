r"""Text and tables as LaTeX, to be taken into a paper by ``\input``."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

from pipeline.errors import visible
from report.markdown import PLAIN_NAME
from report.markup_language import MarkupLanguage

_PREAMBLE = r"% Taken in by \input; above it: \usepackage{booktabs,graphicx}"
_FOREIGN = "% With XeLaTeX or LuaLaTeX, and a font that has these signs: "

_WIDE = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"

_MINUS = "\N{MINUS SIGN}"

_SIGNS = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"{\char34}",  # active in some languages
    "`": r"{\char96}",
    **{sign: f"\\{sign}" for sign in "{}$&#%_"},
    "±": r"$\pm$",
    "\N{MULTIPLICATION SIGN}": r"$\times$",
    "·": r"$\cdot$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "∞": r"$\infty$",
    _MINUS: "$-$",
    "…": r"\ldots{}",
    "†": r"$\dagger$",
}
_NOT_IN_OT1 = "ÐÞðþ«»"  # of Latin-1, all of which pdfLaTeX has with other fonts alone

_BEFORE_A_NUMBER = re.compile(r"(?<![\w.)\]}-])-(?=[\d.∞])")
# Two hyphens or commas become one sign. At the start of a row or an item brackets and asterisks
# would be read as a wish of its command.
_LIGATURES = re.compile(r"(?<=-)(?=-)|(?<=,)(?=,)|(?<=')(?=')")
_COMMAND_ARGUMENT = re.compile(r"^[\[*]")


def escaped(text: str) -> str:
    """Text in which nothing is markup, as any TeX engine sets it that knows its letters."""
    line = _BEFORE_A_NUMBER.sub(_MINUS, " ".join(visible(text).split()))
    line = _LIGATURES.sub("\0", _COMMAND_ARGUMENT.sub(lambda found: f"\0{found[0]}", line))
    return "".join("{}" if sign == "\0" else _SIGNS.get(sign) or _letter(sign) for sign in line)


def _letter(sign: str) -> str:
    """A small Greek letter by its command, and whatever else as it is."""
    greek, _, name = unicodedata.name(sign, "").partition(" SMALL LETTER ")
    return f"${_greek(name)}$" if greek == "GREEK" and _greek(name) else sign


def _greek(name: str) -> str:
    known = "ALPHA BETA GAMMA DELTA EPSILON ZETA ETA THETA KAPPA LAMDA MU NU XI PI RHO SIGMA TAU"
    if name not in [*known.split(), "PHI", "CHI", "PSI", "OMEGA"]:
        return ""
    return "\\" + {"LAMDA": "lambda", "EPSILON": "varepsilon"}.get(name, name.lower())


def latex_table(headings: Sequence[str], rows: Sequence[Sequence[str]], caption: str) -> str:
    """A table with the rules of booktabs, made narrower where it is wider than the text."""
    body = [
        r"\toprule",
        f"{' & '.join(headings)} \\\\",
        r"\midrule",
        *(f"{' & '.join(row)} \\\\" for row in rows),
        r"\bottomrule",
    ]
    return "\n".join(
        [
            r"\begin{table}[htbp]",
            r"\centering",
            f"\\caption{{{caption}}}",
            _WIDE,
            f"\\begin{{tabular}}{{l{'r' * (len(headings) - 1)}}}",
            *body,
            r"\end{tabular}}",
            r"\end{table}",
        ]
    )


def _preamble(content: str) -> str:
    foreign = sorted({sign for sign in content if ord(sign) > 0xFF or sign in _NOT_IN_OT1})
    return "\n".join([_PREAMBLE, *([_FOREIGN + " ".join(foreign)] if foreign else [])])


def _items(texts: Sequence[str]) -> str:
    lines = [f"\\item {escaped(text)}" for text in texts]
    return "\n".join([r"\begin{itemize}", *lines, r"\end{itemize}"])


LATEX = MarkupLanguage(
    preamble=_preamble,
    title=lambda text: f"\\section*{{{escaped(text)}}}",
    heading=lambda text: f"\\subsection*{{{escaped(text)}}}",
    command=lambda text: f"{{\\raggedright\\ttfamily {escaped(text)}\\par}}",
    text=escaped,
    items=_items,
    name=lambda label: (
        f"\\texttt{{{escaped(label)}}}" if PLAIN_NAME.fullmatch(label) else escaped(label)
    ),
    figure=escaped,
    bold=lambda text: f"\\textbf{{{escaped(text)}}}",
    table=latex_table,
)
