"""Products of a few rows against numpy's in float64, over every tile and what is left over from them."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from liir_common.rollout.dense import add_product, affine
from liir_common.rollout.tile import write_tile
from liir_common.types import FloatArray

COLUMNS = [1, 7, 8, 9, 16, 24, 30, 50, 64]


def random(*shape: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("columns", COLUMNS)
@pytest.mark.parametrize("n", range(9))
def test_products_equal_those_in_float64(n: int, columns: int) -> None:
    x, weight, bias, out = random(n, 13), random(13, columns), random(columns), random(n, columns, seed=1)
    product = x.astype(np.float64) @ weight
    added, written = out.copy(), out.copy()
    add_product(x, weight, added)
    affine(x, weight, bias, written)
    np.testing.assert_allclose(added, out + product, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(written, bias + product, rtol=1e-5, atol=1e-5)


def test_a_transposed_factor_is_read_as_it_lies() -> None:
    x, weight, out = random(13, 6), random(13, 30), np.zeros((6, 30), np.float32)
    add_product(x.T, weight, out)
    np.testing.assert_allclose(out, x.T.astype(np.float64) @ weight, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("columns", COLUMNS)
def test_the_bytes_of_an_element_do_not_depend_on_the_tile(columns: int) -> None:
    x, weight, bias = random(7, 64), random(64, columns), random(columns)
    whole, single = np.empty((7, columns), np.float32), np.empty((1, 1), np.float32)
    affine(x, weight, bias, whole)
    for a, j in np.ndindex(whole.shape):
        affine(x[a : a + 1], np.ascontiguousarray(weight[:, j : j + 1]), bias[j : j + 1], single)
        assert single[0, 0] == whole[a, j]


def test_no_rows_and_no_columns_are_nothing_to_do() -> None:
    out = random(3, 5)
    before = out.copy()
    add_product(random(3, 0), random(0, 5), out)
    add_product(random(3, 4), random(4, 0), np.empty((3, 0), np.float32))
    assert (out == before).all()


def test_what_no_tile_can_be_made_of_is_refused() -> None:
    x, weight, out = random(3, 4), random(4, 5), random(3, 5)
    with pytest.raises(TypingError, match="float32 matrices"):
        add_product(x.astype(np.float64), weight, out)
    with pytest.raises(TypingError, match="C-contiguous"):
        add_product(x, np.asfortranarray(weight), out)

    @njit
    def of_variable_size(rows, x, weight, out):  # type: ignore[no-untyped-def]
        write_tile(rows, 1, 1, x, weight, out, out, 0, 0)

    with pytest.raises(TypingError, match="literal rows"):
        of_variable_size(2, x, weight, out)
