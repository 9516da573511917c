"""What is kept on disk: atomic writes, locks and records."""
