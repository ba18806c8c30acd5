"""Files of plain numbers, read without running anything in them: those of this program, and those of torch."""
