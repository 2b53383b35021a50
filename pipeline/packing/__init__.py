"""A finished run as a pack for others: model, settings, figures, and a card for a model hub."""
