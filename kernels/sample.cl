/* Bilinear gather with the border clamped: a run of points a work-item.
 *
 * Pictures have a kernel of their own: a loop of known length takes half the time.
 */

#define RUN 16

/* 0 ... most. PoCL 3.0 calls its own clamp as a function. */
float within(const float x, const float most)
{
    return x < 0.0f ? 0.0f : x > most ? most : x;
}

/* The value between two of a row and two of the next. */
float between(__global const float *near, __global const float *far, const int step,
              const float fx, const float fy)
{
    const float a0 = (1.0f - fx) * near[0] + fx * near[step];
    const float a1 = (1.0f - fx) * far[0] + fx * far[step];
    return (1.0f - fy) * a0 + fy * a1;
}

__kernel void sample(
    __global const float *restrict field,  /* (fields, H, W, C), fields is 1 or the batch */
    __global const float2 *restrict points, /* (sets, N) = (x, y) [px], sets is 1 or the batch */
    const int fields,
    const int sets,
    const int number,                      /* N */
    const int height,
    const int width,
    const int channels,
    const int first,
    const int count,
    /* outputs */
    __global float *restrict sampled)      /* (batch, N, C) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int runs = (number + RUN - 1) / RUN;
    const int b = (first + tid) / runs;
    const int start = (first + tid) % runs * RUN;
    const int stop = start + RUN < number ? start + RUN : number;
    const int origin = (b % fields) * height * width;
    const float right = width - 1;
    const float bottom = height - 1;
    for (int p = start; p < stop; ++p) {
        const float2 point = points[(b % sets) * number + p];
        const float x = within(point.x, right);
        const float y = within(point.y, bottom);
        const int x0 = (int)x;
        const int y0 = (int)y;
        const float fx = x - x0;
        const float fy = y - y0;
        const int step = x0 + 1 < width ? channels : 0;
        __global const float *near = field + (origin + y0 * width + x0) * channels;
        __global const float *far = y0 + 1 < height ? near + width * channels : near;
        __global float *out = sampled + (b * number + p) * channels;
        for (int c = 0; c < channels; ++c)
            out[c] = between(near + c, far + c, step, fx, fy);
    }
}

__kernel void sample_pictures(
    __global const float *restrict pictures, /* (fields, H, W, 3), fields is 1 or the batch */
    __global const float2 *restrict points,  /* (sets, N) = (x, y) [px], sets is 1 or the batch */
    const int fields,
    const int sets,
    const int number,                        /* N */
    const int height,
    const int width,
    const int first,
    const int count,
    /* outputs */
    __global float *restrict sampled)        /* (batch, N, 3) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int runs = (number + RUN - 1) / RUN;
    const int b = (first + tid) / runs;
    const int start = (first + tid) % runs * RUN;
    const int stop = start + RUN < number ? start + RUN : number;
    const int origin = (b % fields) * height * width;
    const float right = width - 1;
    const float bottom = height - 1;
    for (int p = start; p < stop; ++p) {
        const float2 point = points[(b % sets) * number + p];
        const float x = within(point.x, right);
        const float y = within(point.y, bottom);
        const int x0 = (int)x;
        const int y0 = (int)y;
        const float fx = x - x0;
        const float fy = y - y0;
        const int step = x0 + 1 < width ? 3 : 0;
        __global const float *near = pictures + 3 * (origin + y0 * width + x0);
        __global const float *far = y0 + 1 < height ? near + 3 * width : near;
        __global float *out = sampled + 3 * (b * number + p);
        for (int c = 0; c < 3; ++c)
            out[c] = between(near + c, far + c, step, fx, fy);
    }
}
