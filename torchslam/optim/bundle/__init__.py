"""Bundle adjustment in two formulations: sparse, and dense with a backend in PyTorch and one in NumPy."""
