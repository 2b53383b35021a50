"""The page of a tuning: what was found, how, and what it cost."""

from report.tuning_page.tuning_assembly import write_tuning_page

__all__ = ["write_tuning_page"]
