"""What is kept of a test: one record per frame, the folder that holds them, and other programs' formats."""
