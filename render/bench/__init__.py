"""The camera measured: flat fields, the data sheet, and fits of a sensor to measured frames."""
