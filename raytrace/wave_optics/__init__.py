"""Wave optics: thin phase elements, the propagation of light behind them, and their PSFs."""
