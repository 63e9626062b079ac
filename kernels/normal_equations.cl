/* Inner products of images with each other and with another image: a Gram matrix, and beside it the
 * right-hand side of a least squares fit.
 *
 * `multiply` adds up a piece of all images, for blocks of 4 x 4 products that share their loads: in
 * float, 16 lanes of 64 terms. What is wanted stands after the last image. `add_up` adds the pieces
 * in double.
 */

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#include "lanes.cl"

#define PIECE 1024 /* values: of 50 images they fit into L2, of eight into L1 */
#define ROWS 4
#define PRODUCTS (ROWS * ROWS)

__kernel void multiply(
    __global const float *images, /* (M, stride) */
    __global const float *wanted, /* (S,) */
    const int number,             /* M */
    const int stride,             /* values from one image to the next */
    const int size,               /* S */
    const int before,             /* pieces that are multiplied already */
    const int first,
    const int count,
    /* outputs */
    __global float *parts)        /* (pieces, M + 1, M), where the row is not before the column */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int blocks = number / ROWS + 1;
    const int pairs = blocks * (blocks + 1) / 2;
    const int piece = (first + tid) / pairs;
    int column = (first + tid) % pairs; /* of the triangle of blocks, row after row */
    int row = 0;
    while (column > row)
        column -= ++row;
    __global const float *left[ROWS];
    __global const float *right[ROWS];
#pragma unroll
    for (int j = 0; j < ROWS; ++j) {
        const int r = ROWS * row + j;
        const int c = ROWS * column + j;
        left[j] = r < number ? images + r * stride : wanted;
        right[j] = c < number ? images + c * stride : wanted;
    }
    const int begin = piece * PIECE;
    const int end = begin + PIECE < size ? begin + PIECE : size;
    const int whole = end - (end - begin) % LANES;
    float16 total[PRODUCTS] = {(float16)(0.0f)};
    for (int i = begin; i < whole; i += LANES) {
        float16 a[ROWS];
        float16 b[ROWS];
#pragma unroll
        for (int j = 0; j < ROWS; ++j) {
            a[j] = get(left[j] + i);
            b[j] = get(right[j] + i);
        }
#pragma unroll
        for (int j = 0; j < PRODUCTS; ++j)
            total[j] += a[j / ROWS] * b[j % ROWS];
    }
    parts += (before + piece) * (number + 1) * number;
#pragma unroll
    for (int j = 0; j < PRODUCTS; ++j) {
        const int r = ROWS * row + j / ROWS;
        const int c = ROWS * column + j % ROWS;
        float product = sum(total[j]);
        for (int i = whole; i < end; ++i)
            product += left[j / ROWS][i] * right[j % ROWS][i];
        if (r <= number && c < number)
            parts[r * number + c] = product;
    }
}

__kernel void add_up(
    __global const float *parts, /* (pieces, M + 1, M) */
    const int pieces,
    const int number,            /* M */
    const int first,
    const int count,
    /* outputs */
    __global float *products)    /* (M + 1, M) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int i = (first + tid) / number;
    const int j = (first + tid) % number;
    const int place = i < j ? j * number + i : i * number + j;
    double total = 0.0;
    for (int piece = 0; piece < pieces; ++piece)
        total += (double)parts[piece * (number + 1) * number + place];
    products[first + tid] = (float)total;
}
