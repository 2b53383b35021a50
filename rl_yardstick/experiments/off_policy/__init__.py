"""Off-policy evaluation on the pulls of another policy: ``compare.py --logged``."""
