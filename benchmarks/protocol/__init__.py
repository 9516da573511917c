"""Which photographs a table asks for, and how they are prepared: draws, captures, scenes."""
