"""The decorators of `machine_code.compiling`, where rules written for earlier versions look."""

from machine_code.compiling import called, compiled, inlined, internal, kernel, vectorised, view

__all__ = ["called", "compiled", "inlined", "internal", "kernel", "vectorised", "view"]
