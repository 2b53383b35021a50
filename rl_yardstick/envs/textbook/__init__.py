"""Environments of textbooks and papers, with exact models."""
