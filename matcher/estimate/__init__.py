"""The engine that all evidence shares: fits of a view, and the rules by which an answer is accepted."""
