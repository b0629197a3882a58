"""Three values that go together, such as red, green and blue, as a sum and two differences."""

import numpy as np

# [3, 3] float64, orthonormal. The rows are brightness, red against green, and both against blue (the opponent
# colours of van de Sande et al. 2010, "Evaluating Color Descriptors for Object and Scene Recognition").
# `values @ OPPONENT.T` takes values [..., 3] apart; `@ OPPONENT` puts them together again.
OPPONENT = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]) / np.sqrt([[3], [2], [6]])
