"""A study as one self-contained page: `write_report`.

A page is a list of sections. Each is a function that looks at a study and returns a `Section`, or
None where it has nothing to show; its template lies in ``templates/<name>.html``, and
what makes it move, if anything does, in ``templates/<name>.js``. `report.page.assembly` lists them.
"""

from report.page.assembly import write_report

__all__ = ["write_report"]
