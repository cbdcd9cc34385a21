"""Commands that make, check and show what is kept, and what all commands share.

Commands and options are named by ``phasemark --help``: heavy imports stand inside the functions, for its sake.
"""
