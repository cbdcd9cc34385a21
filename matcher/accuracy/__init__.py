"""Bounds, Monte-Carlo trials and the cost of a bank's grid."""
