"""What is made of a finished result: exports (`export`) and figures (`figures`)."""
