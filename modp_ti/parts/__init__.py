"""Parts: one recording, cut into parts that are mapped by processes of their own, and merged into one map."""
