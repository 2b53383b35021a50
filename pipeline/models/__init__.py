"""Models on disk: found, looked into, loaded, gone on with, and saved."""
