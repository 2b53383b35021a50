"""Policies judged by pulls that another one made: ``compare.py --logged``."""
