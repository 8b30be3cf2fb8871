"""What is looked for on a test's own frames before it is measured: contradictions, element size, mesh, threshold."""
