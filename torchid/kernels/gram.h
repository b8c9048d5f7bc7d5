// Gram matrices of many rows by column, panel by panel: what is worked on stays in the second-level cache.
// Libraries for products of matrices are made for square ones and take up to 2.7 times as long here.
#pragma once
#include "spatial.h"

constexpr Int PANEL = 384; // rows: of two hundred columns they fill half of a second-level cache

// Columns (n, step), of which the first `length` rows, a multiple of TILE, are used.
struct Panel {
    double *data;
    Int n, step, length;
};

// How columns change before they are multiplied: the `lower` ones (k,) become combinations (k, n) of all.
struct Levels {
    Int k;
    const Int *lower;
    const double *combination;
};

// Replace the lower columns, add their sums of squares before to `squares` (k,) and the products of all columns to the
// lower half of `gram` (n, n). `scratch`: (k, PANEL).
void add_gram(const Panel &panel, const Levels &levels, double *scratch, double *squares, double *gram);

// Copy the lower half of a matrix (n, n) to its upper half.
void mirror(double *gram, Int n);
