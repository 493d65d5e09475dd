"""Mathematics without optics.

| module    | contents                                                                                       |
|-----------|------------------------------------------------------------------------------------------------|
| numerics  | functions that stay finite with their gradients; dual numbers; values, dataclasses of tensors  |
| tangents  | tensors that carry their derivatives by n variables: vector forward mode in one pass            |
| sampling  | points and weights on the unit disc (Gauss, hexapolar, Sobol …): table SAMPLINGS; pixel grids   |
| zernike   | Zernike polynomials: Noll's and fringe indices, values, gradients, fits                    |
| bivariate | polynomials in x and y with derivatives                                                        |
| arrays    | .npy and .npz files, read with care                                                            |
| result    | results of public functions: columns, text, document, frame                                    |

To add a sampling: a function of one size that returns points (2, P) and weights (P,), and a row of SAMPLINGS.

Tests: tests/test_numerics, test_dual, test_value (numerics), test_tangents, test_pupil (sampling), test_zernike,
test_result.
"""

from raytrace import namespace

__getattr__, __dir__ = namespace(__name__)
