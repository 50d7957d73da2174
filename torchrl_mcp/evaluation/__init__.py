"""Episodes played for their returns, for each reference motion, and for what gates and options do in them."""
