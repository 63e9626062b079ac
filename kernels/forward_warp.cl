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

__kernel void forward_warp(
    __global const float *field,   /* (fields, H, W, C), fields is 1 or the batch */
    __global const float *flow,    /* (flows, H, W, 2) [px], flows is 1 or the batch */
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
    __global double4 *total,       /* (workers, ceil(H / bands), W), scratch */
    __global double *mass,         /* (workers, ceil(H / bands), W), scratch */
    __global float *warped,        /* (batch, H, W, C), the channels of the group are written */
    __global float *weight)        /* (batch, H, W) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int worker = first + tid;
    const int group = min(channels - channel, GROUP);
    const int rows = (height + bands - 1) / bands;
    const int base = worker * rows * width;
    for (int job = worker; job < batch * bands; job += workers) {
        const int b = job / bands;
        const int top = (job % bands) * rows;
        const int bottom = min(top + rows, height);
        for (int i = 0; i < (bottom - top) * width; ++i) {
            total[base + i] = (double4)(0.0);
            mass[base + i] = 0.0;
        }
        const int source = (b % fields) * height * width;
        const int along = (b % flows) * height * width;
        for (int sy = 0; sy < height; ++sy)
            for (int sx = 0; sx < width; ++sx) {
                const int s = sy * width + sx;
                const float qy = flow[2 * (along + s) + 1];
                const float down = floor(qy);
                const int y = sy + (int)clamp(down, -FAR, FAR);
                if (y < top - 1 || y >= bottom)
                    continue;
                const float qx = flow[2 * (along + s)];
                const float right = floor(qx);
                const int x = sx + (int)clamp(right, -FAR, FAR);
                const float fx = qx - right;
                const float fy = qy - down;
                const float gx = 1.0f - fx;
                const float gy = 1.0f - fy;
                __global const float *pixel = field + (source + s) * channels + channel;
                double4 value = (double4)(pixel[0], 0.0, 0.0, 0.0);
                if (group > 1)
                    value.s1 = pixel[1];
                if (group > 2)
                    value.s2 = pixel[2];
                if (group > 3)
                    value.s3 = pixel[3];
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
            const float4 mean = convert_float4(total[base + i] * scale);
            __global float *pixel = warped + (start + i) * channels + channel;
            pixel[0] = mean.s0;
            if (group > 1)
                pixel[1] = mean.s1;
            if (group > 2)
                pixel[2] = mean.s2;
            if (group > 3)
                pixel[3] = mean.s3;
            weight[start + i] = (float)w;
        }
    }
}
