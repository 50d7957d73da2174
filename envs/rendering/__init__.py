"""Pictures of simulations without a display."""
