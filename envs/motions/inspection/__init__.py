"""What clips look like: measures, feasibility and pictures."""
