"""What a test finds on its own frames before it is measured: element size, refined mesh, threshold of the weights."""
