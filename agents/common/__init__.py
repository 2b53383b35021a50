"""What every hand-written agent shares."""
