"""The page that plays a training step by step."""

from report.learning_page.learning_assembly import write_learning_page

__all__ = ["write_learning_page"]
