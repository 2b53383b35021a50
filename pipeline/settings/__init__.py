"""Settings from files and command lines: read, checked and built, without running any of them."""
