"""Sampled waves: thin elements given by their height, how light spreads behind them, and what a camera makes of it."""
