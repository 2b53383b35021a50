"""Compiling with Numba: decorators, a cache of machine code keyed by sources, and its timing.

The package knows no other one of this project. A package whose machine code is to be kept on disk
says so with `machine_code.sources.keep_machine_code`, and names the sources that decide about it.
"""
