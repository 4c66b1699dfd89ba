"""Making the tasks' queries and demonstrations."""
