"""The methods that a table compares, one file a method, all behind `base.Method`."""
