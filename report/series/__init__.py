"""The numbers that figures show, computed once for those on paper and those on the page."""
