"""Multilayer perceptrons as compiled code: forward pass, gradients and training."""
