"""Sweeps over conditions: plan, trials, tables, report."""
