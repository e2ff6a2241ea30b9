"""A batch: many recordings, each mapped by a task of its own."""
