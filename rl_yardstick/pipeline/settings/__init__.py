"""Reads, checks and builds settings from files and command lines, without running code in them."""
