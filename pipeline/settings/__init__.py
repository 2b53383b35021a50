"""Reads, checks and builds settings from files and command lines, and runs none of them."""
