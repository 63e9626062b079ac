/* Weighted Euclidean distances between two sets of fields (CE05, Eq. 7 and 10).
 *
 * `pack` lays the channels of each field out as planes padded to whole vectors; `distance_scan`
 * walks them 16 points at a time, in float within a block and in double from block to block. Two
 * queries and four rows of the corpus share their loads. The processor's roots of 16 points take as
 * long as all else: with AVX-512 it estimates 1/sqrt instead, else `root` has half of them.
 */

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#include "lanes.cl"

#define MAGIC 0x5f200000
#define TINY 1.2e-38f /* added to squares, so that they have a 1/sqrt */
#define BLOCK 64 /* vectors summed in float */
#define QUERIES 2
#define ROWS 4
#define PAIRS (QUERIES * ROWS)

/* 16 flows anywhere. */
typedef float float32u __attribute__((ext_vector_type(32), aligned(4)));

__kernel void pack(
    __global const float *fields,    /* (N, P, C) */
    const int points,                /* P */
    const int channels,
    const int begin,                 /* the points before it are packed already */
    const int first,
    const int count,
    /* outputs */
    __global float *planes)          /* (count, C, V, 16), zero beyond P; V = ceil(P / 16) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int padded = (points + LANES - 1) / LANES * LANES;
    const int source = (first + tid) * points * channels;
    for (int c = 0; c < channels; ++c) {
        const int target = (tid * channels + c) * padded;
        for (int p = begin; p < points; ++p)
            planes[target + p] = fields[source + p * channels + c];
        for (int p = points; p < padded; ++p)
            planes[target + p] = 0.0f;
    }
}

__kernel void pack_flows(
    __global const float *restrict flows, /* (N, P, 2) */
    const int points,                     /* P */
    const int first,
    const int count,
    /* outputs */
    __global float16 *restrict planes)    /* (count, 2, V, 16): whole vectors are written */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int vectors = (points + LANES - 1) / LANES;
    const int target = 2 * tid * vectors;
    for (int v = 0; v < points / LANES; ++v) {
        const int at = 2 * ((first + tid) * points + v * LANES);
        const float32u flow = *(__global const float32u *)(flows + at);
        planes[target + v] = flow.even;
        planes[target + vectors + v] = flow.odd;
    }
}

#if defined(__AVX512F__) && __has_builtin(__builtin_ia32_rsqrt14ps512_mask)

/* part + w sqrt(x), x > 0, within 2e-7: y is 1/sqrt(x) within 6e-5, of which Newton's step makes
 * sqrt(x) = xy (3 - xyy) / 2.
 */
float16 add_root(const float16 part, const float16 w, const float16 x)
{
    const float16 y = __builtin_ia32_rsqrt14ps512_mask(x, x, (ushort)-1);
    const float16 xy = x * y;
    return part + 0.5f * w * (xy * (3.0f - xy * y));
}

#else

/* sqrt(x), within 8e-7 of it: xy / sqrt(xyy), where y is 1/sqrt(x) by its bits and
 * 0.75 < xyy < 0.844.
 */
float8 root(const float8 x)
{
    const float8 y = as_float8(MAGIC - (as_int8(x) >> 1));
    const float8 xy = x * y;
    const float8 t = xy * y;
    return xy * (2.45213665f + t * (-3.07998830f + t * (2.31981536f + t * -0.692957570f)));
}

#if __has_builtin(__builtin_sqrtf)
#define ROOT __builtin_sqrtf
#else
#define ROOT sqrt
#endif

/* The same by the processor. As functions of single numbers the compiler makes vectors of them; PoCL
 * 3.0 calls its own for vectors.
 */
float8 exact_root(const float8 x)
{
    return (float8)(
        ROOT(x.s0), ROOT(x.s1), ROOT(x.s2), ROOT(x.s3), ROOT(x.s4), ROOT(x.s5), ROOT(x.s6),
        ROOT(x.s7));
}

/* part + w sqrt(x). The unit for roots works beside those for sums and products: half by each. */
float16 add_root(const float16 part, const float16 w, const float16 x)
{
    return part + w * (float16)(exact_root(x.lo), root(x.hi));
}

#endif

double sum_of(const float8 part)
{
    const float4 a = part.lo + part.hi;
    return ((double)a.s0 + (double)a.s1) + ((double)a.s2 + (double)a.s3);
}

__kernel void distance_scan(
    __global const float16 *queries, /* (K, C, V) */
    __global const float16 *planes,  /* (tile, C, V), row 0 is the corpus row `start` */
    __global const float16 *weights, /* (V,) */
    const int number,                /* K */
    const int corpus,                /* N */
    const int start,
    const int tile,                  /* corpus rows of this launch */
    const int vectors,               /* V */
    const int channels,
    const int first,
    const int count,
    /* outputs */
    __global float *distance)        /* (K, N) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int groups = (number + QUERIES - 1) / QUERIES;
    const int row = channels * vectors;
    int k[QUERIES]; /* what is beyond the last is the last again */
    int n[ROWS];
#pragma unroll
    for (int j = 0; j < QUERIES; ++j)
        k[j] = min(QUERIES * ((first + tid) % groups) + j, number - 1);
#pragma unroll
    for (int j = 0; j < ROWS; ++j)
        n[j] = min(ROWS * ((first + tid) / groups) + j, tile - 1);
    double total[PAIRS + 1] = {0.0}; /* the last is of equal fields, where TINY is all there is */
    for (int begin = 0; begin < vectors; begin += BLOCK) {
        const int end = begin + BLOCK < vectors ? begin + BLOCK : vectors;
        float16 part[PAIRS + 1] = {(float16)(0.0f)};
        for (int v = begin; v < end; ++v) {
            float16 norm[PAIRS + 1];
#pragma unroll
            for (int j = 0; j <= PAIRS; ++j)
                norm[j] = (float16)(TINY);
            for (int i = v; i < row; i += vectors)
#pragma unroll
                for (int j = 0; j < PAIRS; ++j) {
                    const float16 d = queries[k[j / ROWS] * row + i] - planes[n[j % ROWS] * row + i];
                    norm[j] += d * d;
                }
#pragma unroll
            for (int j = 0; j <= PAIRS; ++j)
                part[j] = add_root(part[j], weights[v], norm[j]);
        }
#pragma unroll
        for (int j = 0; j <= PAIRS; ++j)
            total[j] += sum_of(part[j].lo + part[j].hi);
    }
#pragma unroll
    for (int j = 0; j < PAIRS; ++j)
        distance[k[j / ROWS] * corpus + start + n[j % ROWS]] =
            total[j] == total[PAIRS] ? 0.0f : (float)total[j];
}
