"""What any command needs: files that are never half written, worker processes, signals."""
