"""What a study has shown: sentences, tables, figures, films, and a page."""
