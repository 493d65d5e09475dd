"""Mathematics that knows no optics: safe arithmetic, values, points on the disc, pixels, Zernike polynomials."""
