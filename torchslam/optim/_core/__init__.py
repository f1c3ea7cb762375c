"""What all solvers share: Levenberg-Marquardt, implicit gradients, manifolds, residuals and priors."""
