"""Files that are never half written, and worker processes."""
