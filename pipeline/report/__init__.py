"""A study as one self-contained page: `write_report`.

A page is a list of sections. Each is a module with a function that looks at a study and returns a
`Section`, or None where it has nothing to show; its template lies in ``templates/<name>.html``, and
what makes it move, if anything does, in ``templates/<name>.js``. `pipeline.report.page` lists them.
"""

from pipeline.report.page import write_report

__all__ = ["write_report"]
