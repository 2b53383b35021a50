"""Multilayer perceptrons as compiled code: how they are evaluated, differentiated and trained."""
