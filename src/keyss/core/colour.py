"""Opponent colours: red, green and blue as a sum and two differences."""

import numpy as np

# [3, 3] float64, orthonormal. The rows are brightness, red minus green, and both minus blue (van de Sande et
# al. 2010, "Evaluating Color Descriptors for Object and Scene Recognition"). `values @ OPPONENT.T` transforms
# values [..., 3], `@ OPPONENT` is the inverse.
OPPONENT = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]) / np.sqrt([[3], [2], [6]])
