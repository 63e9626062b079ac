/* Forward warping: bilinear splatting along a flow, normalised by the weight that arrived.
 *
 * A worker owns one accumulator and one band of target rows at a time, and scans the whole source
 * in raster order: no atomics, and the same bits for any number of workers and bands. Sums are
 * double (a flow may send a whole picture to one pixel). One launch takes up to four channels.
 */

#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#pragma OPENCL FP_CONTRACT OFF

#define FAR 1.0e8f /* [px] beyond any picture, inside int */
#define GROUP 4

/* q, or what is as far outside. PoCL 3.0 calls its own clamp and floor as functions. */
float within(const float q)
{
    return q < -FAR ? -FAR : q > FAR ? FAR : q;
}

/* The whole number at or below q. */
int whole(const float q)
{
    const int towards = (int)within(q);
    return towards - (within(q) < (float)towards);
}

__kernel void forward_warp(
    __global const float *restrict field,   /* (fields, H, W, C), fields is 1 or the batch */
    __global const float2 *restrict flow,    /* (flows, H, W, 2) [px], flows is 1 or the batch */
    const int fields,
    const int flows,
    const int batch,
    const int height,
    const int width,
    const int channels,
    const int channel,             /* the first of the group */
    const int bands,
    const int workers,
    const int first,
    const int count,
    /* outputs */
    __global double4 *restrict total,       /* (workers, ceil(H / bands), W), scratch */
    __global double *restrict mass,         /* (workers, ceil(H / bands), W), scratch */
    __global float *restrict warped,        /* (batch, H, W, C), the channels of the group are written */
    __global float *restrict weight)        /* (batch, H, W) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int worker = first + tid;
    const int group = channels - channel < GROUP ? channels - channel : GROUP;
    const int rows = (height + bands - 1) / bands;
    const int base = worker * rows * width;
    for (int i = 0; i < rows * width; ++i) {
        total[base + i] = (double4)(0.0);
        mass[base + i] = 0.0;
    }
    for (int job = worker; job < batch * bands; job += workers) {
        const int b = job / bands;
        const int top = (job % bands) * rows;
        const int bottom = top + rows < height ? top + rows : height;
        const int source = (b % fields) * height * width;
        const int along = (b % flows) * height * width;
        for (int sy = 0; sy < height; ++sy)
            for (int sx = 0; sx < width; ++sx) {
                const int s = sy * width + sx;
                const float2 q = flow[along + s];
                const int down = whole(q.y);
                const int y = sy + down;
                if (y < top - 1 || y >= bottom)
                    continue;
                const int right = whole(q.x);
                const int x = sx + right;
                const float fx = within(q.x) - right;
                const float fy = within(q.y) - down;
                const float gx = 1.0f - fx;
                const float gy = 1.0f - fy;
                __global const float *pixel = field + (source + s) * channels + channel;
                double4 value = (double4)(pixel[0], 0.0, 0.0, 0.0);
                if (group == GROUP)
                    value = (double4)(pixel[0], pixel[1], pixel[2], pixel[3]);
                else if (group == 3)
                    value = (double4)(pixel[0], pixel[1], pixel[2], 0.0);
                else if (group == 2)
                    value.s1 = pixel[1];
                const int t = base + (y - top) * width + x;
                if (x >= 0 && x + 1 < width && y >= top && y + 1 < bottom) {
                    const double w00 = gx * gy;
                    const double w01 = fx * gy;
                    const double w10 = gx * fy;
                    const double w11 = fx * fy;
                    total[t] += w00 * value;
                    total[t + 1] += w01 * value;
                    total[t + width] += w10 * value;
                    total[t + width + 1] += w11 * value;
                    mass[t] += w00;
                    mass[t + 1] += w01;
                    mass[t + width] += w10;
                    mass[t + width + 1] += w11;
                } else {
                    for (int tap = 0; tap < 4; ++tap) {
                        const int dx = tap % 2;
                        const int dy = tap / 2;
                        if (x + dx >= 0 && x + dx < width && y + dy >= top && y + dy < bottom) {
                            const double w = (dx ? fx : gx) * (dy ? fy : gy);
                            total[t + dy * width + dx] += w * value;
                            mass[t + dy * width + dx] += w;
                        }
                    }
                }
            }
        const int start = (b * height + top) * width;
        for (int i = 0; i < (bottom - top) * width; ++i) {
            const double w = mass[base + i];
            const double scale = w > 0.0 ? 1.0 / w : 0.0;
            const double4 mean = total[base + i] * scale;
            total[base + i] = (double4)(0.0); /* for the next job */
            mass[base + i] = 0.0;
            __global float *pixel = warped + (start + i) * channels + channel;
            pixel[0] = (float)mean.s0;
            if (group > 1)
                pixel[1] = (float)mean.s1;
            if (group > 2)
                pixel[2] = (float)mean.s2;
            if (group > 3)
                pixel[3] = (float)mean.s3;
            weight[start + i] = (float)w;
        }
    }
}
