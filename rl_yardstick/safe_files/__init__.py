"""Reads model files of unknown origin without running any code in them.

It depends on the libraries whose files it reads, and on nothing else in this project.
"""
