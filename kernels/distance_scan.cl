/* Weighted Euclidean distances between two sets of fields (CE05, Eq. 7 and 10).
 *
 * `pack` lays the channels of each field out as planes padded to whole vectors; `distance_scan`
 * walks them 8 points at a time (PoCL 3.0 aborts the process on a sqrt of 16 floats), in float within
 * a block and in double from block to block. Two queries share each load of the corpus.
 */

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#define LANES 16
#define BLOCK 32 /* halves of a vector summed in float */

__kernel void pack(
    __global const float *fields,    /* (N, P, C) */
    const int points,                /* P */
    const int channels,
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
        for (int p = 0; p < points; ++p)
            planes[target + p] = fields[source + p * channels + c];
        for (int p = points; p < padded; ++p)
            planes[target + p] = 0.0f;
    }
}

double sum(const float8 part)
{
    const double4 a = convert_double4(part.lo) + convert_double4(part.hi);
    return (a.s0 + a.s1) + (a.s2 + a.s3);
}

__kernel void distance_scan(
    __global const float8 *queries,  /* (K, C, 2 V) */
    __global const float8 *planes,   /* (tile, C, 2 V), row 0 is the first corpus row of the launch */
    __global const float8 *weights,  /* (2 V,) */
    const int number,                 /* K */
    const int corpus,                 /* N */
    const int vectors,                /* V */
    const int channels,
    const int first,
    const int count,
    /* outputs */
    __global float *distance)         /* (K, N) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int pairs = (number + 1) / 2;
    const int k0 = 2 * ((first + tid) % pairs);
    const int k1 = min(k0 + 1, number - 1); /* of an odd number the last query is done twice */
    const int n = (first + tid) / pairs;
    const int halves = 2 * vectors;
    const int q0 = k0 * channels * halves;
    const int q1 = k1 * channels * halves;
    const int f = (n - first / pairs) * channels * halves;
    double total0 = 0.0;
    double total1 = 0.0;
    for (int start = 0; start < halves; start += BLOCK) {
        float8 part0 = (float8)(0.0f);
        float8 part1 = (float8)(0.0f);
        for (int v = start; v < min(start + BLOCK, halves); ++v) {
            float8 norm0 = (float8)(0.0f);
            float8 norm1 = (float8)(0.0f);
            for (int c = 0; c < channels; ++c) {
                const float8 plane = planes[f + c * halves + v];
                const float8 r0 = queries[q0 + c * halves + v] - plane;
                const float8 r1 = queries[q1 + c * halves + v] - plane;
                norm0 += r0 * r0;
                norm1 += r1 * r1;
            }
            part0 += weights[v] * sqrt(norm0);
            part1 += weights[v] * sqrt(norm1);
        }
        total0 += sum(part0);
        total1 += sum(part1);
    }
    distance[k0 * corpus + n] = (float)total0;
    distance[k1 * corpus + n] = (float)total1;
}
