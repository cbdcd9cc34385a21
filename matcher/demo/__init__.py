"""The paper's experiment as one command."""
