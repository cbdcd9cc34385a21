"""Work in parts: shards of a file, the threads or the cluster that make them, and how a run goes on."""
