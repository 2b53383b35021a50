"""One run: its settings, training, evaluation, folder and state."""
