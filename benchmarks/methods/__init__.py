"""The methods that a table compares, one file per method, all behind `base.Method`."""
