"""Files of queries, demonstrations, observations and roadmap paths."""
