/* Weighted sums of images, accumulated in double: 16 values a work-item, then what is left over.
 *
 * Four at a time: PoCL 3.0 compiles for CPUs without AVX-512, and warns of wider arguments.
 */

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#define LANES 16
#define BLOCK 8 /* terms summed in float */

__kernel void blend(
    __global const float *images,   /* (M, S) */
    __global const float *weights,  /* (batch, M) */
    const int number,               /* M */
    const int size,                 /* S */
    const int first,
    const int count,
    /* outputs */
    __global float *blended)        /* (batch, S), the whole vectors of each row are written */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int vectors = size / LANES;
    const int b = (first + tid) / vectors;
    const int start = (first + tid) % vectors * LANES;
    double4 total[LANES / 4] = {(double4)(0.0), (double4)(0.0), (double4)(0.0), (double4)(0.0)};
    for (int begin = 0; begin < number; begin += BLOCK) {
        float8 part[2] = {(float8)(0.0f), (float8)(0.0f)};
        for (int m = begin; m < min(begin + BLOCK, number); ++m) {
            const float w = weights[b * number + m];
            if (w != 0.0f) {
                part[0] += w * vload8(0, images + m * size + start);
                part[1] += w * vload8(1, images + m * size + start);
            }
        }
        total[0] += convert_double4(part[0].lo);
        total[1] += convert_double4(part[0].hi);
        total[2] += convert_double4(part[1].lo);
        total[3] += convert_double4(part[1].hi);
    }
    for (int lane = 0; lane < LANES / 4; ++lane)
        vstore4(convert_float4(total[lane]), lane, blended + b * size + start);
}

__kernel void blend_rest(
    __global const float *images,   /* (M, S) */
    __global const float *weights,  /* (batch, M) */
    const int number,               /* M */
    const int size,                 /* S */
    const int first,
    const int count,
    /* outputs */
    __global float *blended)        /* (batch, S), the last S % 16 of each row are written */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int rest = size % LANES;
    const int b = (first + tid) / rest;
    const int p = size - rest + (first + tid) % rest;
    double total = 0.0;
    for (int m = 0; m < number; ++m)
        total += (double)weights[b * number + m] * (double)images[m * size + p];
    blended[b * size + p] = (float)total;
}
