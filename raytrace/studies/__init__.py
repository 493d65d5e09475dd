"""Experiments: each a folder with its computation, figures, pages and command. Nothing imports them."""
