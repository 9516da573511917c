"""Running a table: what is planned, what a method makes, and the cells that are kept."""
