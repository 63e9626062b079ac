/* Weighted sums of images: 64 values of one result or 16 of four a work-item, then what is left over.
 *
 * Eight terms at a time in float, which leaves at most eight roundings of theirs, and those sums in
 * double, for any number of images. PoCL 3.0 calls its own vload and conversions as functions.
 */

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#include "lanes.cl"

#define BLOCK 8 /* terms summed in float */
#define VECTORS 4 /* vectors of one result a work-item: neighbours come from memory together */
#define TOGETHER 4 /* results for which each image is read once */

double4 wide(const float4 x)
{
    return (double4)(x.s0, x.s1, x.s2, x.s3);
}

float4 narrow(const double4 x)
{
    return (float4)(x.s0, x.s1, x.s2, x.s3);
}

void add(double4 *total, const float16 part)
{
    total[0] += wide(part.s0123);
    total[1] += wide(part.s4567);
    total[2] += wide(part.s89ab);
    total[3] += wide(part.scdef);
}

void put_total(__global float *p, const double4 *total)
{
    put(p, (float16)(narrow(total[0]), narrow(total[1]), narrow(total[2]), narrow(total[3])));
}

__kernel void blend(
    __global const float *restrict images,   /* (M, S) */
    __global const float *restrict weights,  /* (1, M) */
    const int number,                        /* M */
    const int size,                          /* S */
    const int first,
    const int count,
    /* outputs */
    __global float *restrict blended)        /* (1, S), whole vectors are written */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int last = size / LANES - 1;
    int start[VECTORS]; /* the last vector again, where there are fewer */
    double4 total[VECTORS][LANES / 4];
#pragma unroll
    for (int r = 0; r < VECTORS; ++r) {
        const int v = (first + tid) * VECTORS + r;
        start[r] = LANES * (v < last ? v : last);
        for (int k = 0; k < LANES / 4; ++k)
            total[r][k] = (double4)(0.0);
    }
    for (int begin = 0; begin < number; begin += BLOCK) {
        const int end = begin + BLOCK < number ? begin + BLOCK : number;
        float16 part[VECTORS];
#pragma unroll
        for (int r = 0; r < VECTORS; ++r)
            part[r] = (float16)(0.0f);
        for (int m = begin; m < end; ++m)
#pragma unroll
            for (int r = 0; r < VECTORS; ++r)
                part[r] += weights[m] * get(images + m * size + start[r]);
#pragma unroll
        for (int r = 0; r < VECTORS; ++r)
            add(total[r], part[r]);
    }
#pragma unroll
    for (int r = 0; r < VECTORS; ++r)
        put_total(blended + start[r], total[r]);
}

__kernel void blend_together(
    __global const float *restrict images,   /* (M, S) */
    __global const float *restrict weights,  /* (batch, M) */
    const int number,                        /* M */
    const int size,                          /* S */
    const int batch,
    const int first,
    const int count,
    /* outputs */
    __global float *restrict blended)        /* (batch, S), the whole vectors of each row are written */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int vectors = size / LANES;
    const int start = (first + tid) % vectors * LANES;
    int b[TOGETHER]; /* the last one again, where there are fewer */
    double4 total[TOGETHER][LANES / 4];
#pragma unroll
    for (int r = 0; r < TOGETHER; ++r) {
        const int row = (first + tid) / vectors * TOGETHER + r;
        b[r] = row < batch ? row : batch - 1;
        for (int k = 0; k < LANES / 4; ++k)
            total[r][k] = (double4)(0.0);
    }
    for (int begin = 0; begin < number; begin += BLOCK) {
        const int end = begin + BLOCK < number ? begin + BLOCK : number;
        float16 part[TOGETHER];
#pragma unroll
        for (int r = 0; r < TOGETHER; ++r)
            part[r] = (float16)(0.0f);
        for (int m = begin; m < end; ++m) {
            const float16 values = get(images + m * size + start);
#pragma unroll
            for (int r = 0; r < TOGETHER; ++r)
                part[r] += weights[b[r] * number + m] * values;
        }
#pragma unroll
        for (int r = 0; r < TOGETHER; ++r)
            add(total[r], part[r]);
    }
#pragma unroll
    for (int r = 0; r < TOGETHER; ++r)
        put_total(blended + b[r] * size + start, total[r]);
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
