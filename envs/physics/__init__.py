"""Physics engines: many simulations of one model as torch tensors."""
