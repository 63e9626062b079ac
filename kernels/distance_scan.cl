/* Weighted Euclidean distances between two sets of fields (CE05, Eq. 7 and 10).
 *
 * `pack` lays the channels of each field out as planes padded to whole vectors; `distance_scan`
 * walks them 16 points at a time, in float within a block and in double from block to block. Two
 * queries and two rows of the corpus share their loads. PoCL 3.0 aborts the process on a sqrt of 16
 * floats, and it would be slower than `root`.
 */

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#define LANES 16
#define MAGIC 0x5f200000
#define BLOCK 16 /* vectors summed in float */

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

/* sqrt(x), within 8e-7 of it: xy / sqrt(xyy), where y is 1/sqrt(x) by its bits and
 * 0.75 < xyy < 0.844.
 */
float16 root(const float16 x)
{
    const float16 y = as_float16(MAGIC - (as_int16(x) >> 1));
    const float16 xy = x * y;
    const float16 t = xy * y;
    return xy * (2.45213665f + t * (-3.07998830f + t * (2.31981536f + t * -0.692957570f)));
}

double sum(const float16 part)
{
    const float8 b = part.lo + part.hi;
    const double4 a = convert_double4(b.lo) + convert_double4(b.hi);
    return (a.s0 + a.s1) + (a.s2 + a.s3);
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
    const int pairs = (number + 1) / 2;
    const int k0 = 2 * ((first + tid) % pairs);
    const int k1 = min(k0 + 1, number - 1); /* of an odd number the last is done twice */
    const int n0 = 2 * ((first + tid) / pairs);
    const int n1 = min(n0 + 1, tile - 1);
    const int row = channels * vectors;
    double4 total = (double4)(0.0);
    for (int begin = 0; begin < vectors; begin += BLOCK) {
        float16 part00 = (float16)(0.0f);
        float16 part01 = (float16)(0.0f);
        float16 part10 = (float16)(0.0f);
        float16 part11 = (float16)(0.0f);
        for (int v = begin; v < min(begin + BLOCK, vectors); ++v) {
            float16 norm00 = (float16)(0.0f);
            float16 norm01 = (float16)(0.0f);
            float16 norm10 = (float16)(0.0f);
            float16 norm11 = (float16)(0.0f);
            for (int i = v; i < row; i += vectors) {
                const float16 q0 = queries[k0 * row + i];
                const float16 q1 = queries[k1 * row + i];
                const float16 f0 = planes[n0 * row + i];
                const float16 f1 = planes[n1 * row + i];
                norm00 += (q0 - f0) * (q0 - f0);
                norm01 += (q0 - f1) * (q0 - f1);
                norm10 += (q1 - f0) * (q1 - f0);
                norm11 += (q1 - f1) * (q1 - f1);
            }
            part00 += weights[v] * root(norm00);
            part01 += weights[v] * root(norm01);
            part10 += weights[v] * root(norm10);
            part11 += weights[v] * root(norm11);
        }
        total += (double4)(sum(part00), sum(part01), sum(part10), sum(part11));
    }
    distance[k0 * corpus + start + n0] = (float)total.s0;
    distance[k0 * corpus + start + n1] = (float)total.s1;
    distance[k1 * corpus + start + n0] = (float)total.s2;
    distance[k1 * corpus + start + n1] = (float)total.s3;
}
