"""Light that bounces: patches, the transport between them, and what reaches the pixels (PHYSICS section 12)."""
