"""Work in parts: shards of a file, the processes that make them, and how a run goes on."""
