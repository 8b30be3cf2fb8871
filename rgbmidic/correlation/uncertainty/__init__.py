"""Standard uncertainty of nodal quantities: the scores' covariance from the residual, carried through the equations."""
