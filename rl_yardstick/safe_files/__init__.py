"""Reads model files of unknown origin without running any code in them.

`models`, and `buffers_and_statistics`, have what replaces the library's functions. The package
depends on the libraries whose files it reads, and on nothing else in this project.
"""
