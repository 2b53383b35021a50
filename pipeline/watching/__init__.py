"""What a training looks like step by step, kept while it goes on, for a page that plays it."""
