/* Prototypes moved along flows of the model, each by itself or mixed: CE05, Eq. 2 in one launch.
 *
 * The flow that is missing to a prototype, carried to its pixels, is a fixed sparse mean of the
 * model's flow less a fixed flow (see mmmgpu/backends/orientation.py). Along it the pixels are
 * splatted into an accumulator that belongs to the worker alone. What received too little is filled
 * by pull-push, of which only the coarse levels and the pixels that are asked for are computed.
 */

#pragma OPENCL FP_CONTRACT OFF

#define FAR 1.0e8f /* [px] beyond any picture, inside int */
#define TAPS 6

/* Add pixel (sx, sy), carried along q, to the four pixels around where it arrives. */
void splat(__global float4 *total, const int h, const int w, const int sy, const int sx,
           const float2 q, const float4 value)
{
    const float2 whole = floor(q);
    const float2 f = q - whole;
    const float2 g = 1.0f - f;
    const int2 step = convert_int2(clamp(whole, -FAR, FAR));
    const int x = sx + step.x;
    const int y = sy + step.y;
    const int t = y * w + x;
    if (x >= 0 && x + 1 < w && y >= 0 && y + 1 < h) {
        total[t] += g.x * g.y * value;
        total[t + 1] += f.x * g.y * value;
        total[t + w] += g.x * f.y * value;
        total[t + w + 1] += f.x * f.y * value;
    } else {
        for (int tap = 0; tap < 4; ++tap) {
            const int dx = tap % 2;
            const int dy = tap / 2;
            if (x + dx >= 0 && x + dx < w && y + dy >= 0 && y + dy < h)
                total[t + dy * w + dx] += (dx ? f.x : g.x) * (dy ? f.y : g.y) * value;
        }
    }
}

/* Splat all pixels of prototype m. */
void move(const int m, __global const float4 *images, __global const float2 *fixed,
          __global const int *taps, __global const float *shares, __global const int *rows,
          __global const int *targets, __global const int *starts, __global const int *row_taps,
          __global const float *row_shares, const int h, const int w, __global float2 *field,
          __global float4 *total)
{
    const int area = h * w;
    for (int i = 0; i < area; ++i)
        total[i] = (float4)(0.0f);
    for (int y = 0; y < h; ++y)
        for (int x = 0; x < w; ++x) {
            const int i = m * area + y * w + x;
            if (taps[TAPS * i] < 0)
                continue;
            float2 near = -fixed[i];
            for (int tap = 0; tap < TAPS; ++tap)
                near += shares[TAPS * i + tap] * field[taps[TAPS * i + tap]];
            splat(total, h, w, y, x, near, images[i]);
        }
    for (int row = rows[m]; row < rows[m + 1]; ++row) {
        float2 far = (float2)(0.0f);
        for (int j = starts[row]; j < starts[row + 1]; ++j)
            far += row_shares[j] * field[row_taps[j]];
        const int s = targets[row];
        const int i = m * area + s;
        if (s < area)
            splat(total, h, w, s / w, s % w, far - fixed[i], images[i]);
        else
            field[s] = far;
    }
}

/* The mean and a weight of 1 where at least that weight arrived, else nothing. */
float4 mean(const float4 sum, const float least)
{
    return sum.w >= least ? sum * (1.0f / sum.w) : (float4)(0.0f);
}

/* The level after this one: sums over the valid pixels of blocks, and their number. */
void pull(__global float4 *fine, const int h, const int w, const float hole, const int finest)
{
    __global float4 *coarse = fine + h * w;
    const int columns = (w + 1) / 2;
    for (int y = 0; y < (h + 1) / 2; ++y) {
        __global const float4 *upper = fine + 2 * y * w;
        __global const float4 *lower = fine + min(2 * y + 1, h - 1) * w;
        const float twice = 2 * y + 1 < h ? 1.0f : 0.5f;
        for (int x = 0; x < columns; ++x) {
            const int left = 2 * x;
            const int right = min(left + 1, w - 1);
            float4 a = upper[left];
            float4 b = upper[right];
            float4 c = lower[left];
            float4 d = lower[right];
            if (finest) {
                a = mean(a, hole);
                b = mean(b, hole);
                c = mean(c, hole);
                d = mean(d, hole);
            }
            const float share = left + 1 < w ? twice : 0.5f * twice;
            coarse[y * columns + x] = share * (a + b + c + d);
        }
    }
}

/* The pixel (x, y) of a level, interpolated from the next one. */
float4 between(__global const float4 *fine, const int h, const int w, const int y, const int x)
{
    const int columns = (w + 1) / 2;
    const int x0 = x / 2;
    const int x1 = clamp(x0 + 2 * (x % 2) - 1, 0, columns - 1);
    __global const float4 *y0 = fine + h * w + y / 2 * columns;
    __global const float4 *y1 =
        fine + h * w + clamp(y / 2 + 2 * (y % 2) - 1, 0, (h - 1) / 2) * columns;
    const float4 near = 0.75f * y0[x0] + 0.25f * y0[x1];
    const float4 far = 0.75f * y1[x0] + 0.25f * y1[x1];
    return 0.75f * near + 0.25f * far;
}

/* Pull-push of all levels but the finest. Returns the number of pixels that are no holes. */
int fill(__global float4 *total, const int height, const int width, const float hole)
{
    int h = height;
    int w = width;
    __global float4 *at = total;
    int levels = 0;
    while (h > 1 || w > 1) {
        pull(at, h, w, hole, levels == 0);
        at += h * w;
        h = (h + 1) / 2;
        w = (w + 1) / 2;
        ++levels;
    }
    const int number = (int)(at[0].w + 0.5f);
    at[0] = mean(at[0], 0.5f);
    for (int up = 1; up < levels; ++up) {
        h = height;
        w = width;
        at = total;
        for (int level = 0; level < levels - up; ++level) {
            at += h * w;
            h = (h + 1) / 2;
            w = (w + 1) / 2;
        }
        for (int y = 0; y < h; ++y)
            for (int x = 0; x < w; ++x) {
                const float4 cell = at[y * w + x];
                at[y * w + x] = cell.w >= 0.5f ? mean(cell, 0.5f) : between(at, h, w, y, x);
            }
    }
    return number;
}

__kernel void move_prototypes(
    __global const float2 *flow,   /* (H * W) [px] of the model */
    __global const float4 *images, /* (M, H * W), weight 1 */
    __global const float2 *fixed,  /* (M, H * W) [px] taken off the mean of flow */
    __global const int *taps,      /* (M, H * W, 6) pixels of the mean; first -1: own row */
    __global const float *shares,  /* (M, H * W, 6) their shares */
    __global const int *rows,      /* (M + 1) first row of each prototype */
    __global const int *targets,   /* (rows) what a row is for: a pixel, or from H * W on a cell */
    __global const int *starts,    /* (rows + 1) its first tap */
    __global const int *row_taps,  /* pixels, or from H * W on cells of rows before */
    __global const float *row_shares,
    __global const int *used,      /* (n,) prototypes */
    __global const int *pixels,    /* (P,) that are asked for */
    __global const float *scale,   /* (P,) of what is written there */
    const int number,              /* n */
    const int asked,               /* P */
    const int height,
    const int width,
    const int size,                /* of a pyramid */
    const int nodes,               /* H * W and cells of a prototype */
    const float hole,
    const int workers,
    const int first,
    const int count,
    /* outputs */
    __global float4 *total,        /* (workers, size) scratch */
    __global float2 *field,        /* (workers, nodes) scratch */
    __global float *moved,         /* (n, P, 3) */
    __global int *arrived)         /* (n,) 0 where a prototype has nothing but holes */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    __global float4 *here = total + (first + tid) * size;
    __global float2 *there = field + (first + tid) * nodes;
    for (int i = 0; i < height * width; ++i)
        there[i] = flow[i];
    for (int job = first + tid; job < number; job += workers) {
        move(used[job], images, fixed, taps, shares, rows, targets, starts, row_taps, row_shares,
             height, width, there, here);
        __global float *out = moved + 3 * job * asked;
        int gaps = 0;
        for (int i = 0; i < asked; ++i) {
            const float4 sum = here[pixels[i]];
            if (sum.w >= hole)
                vstore3(scale[i] * mean(sum, hole).xyz, i, out);
            else
                ++gaps;
        }
        arrived[job] = asked - gaps;
        if (gaps == 0)
            continue;
        arrived[job] = fill(here, height, width, hole);
        for (int i = 0; i < asked; ++i) {
            const int s = pixels[i];
            if (here[s].w < hole)
                vstore3(scale[i] * between(here, height, width, s / width, s % width).xyz, i, out);
        }
    }
}

__kernel void mix_prototypes(
    __global const float2 *flows,  /* (frames, H * W) [px] of the model */
    __global const float4 *images, /* (M, H * W), weight 1 */
    __global const float2 *fixed,  /* (M, H * W) [px] taken off the mean of a flow */
    __global const int *taps,      /* (M, H * W, 6) pixels of the mean; first -1: own row */
    __global const float *shares,  /* (M, H * W, 6) their shares */
    __global const int *rows,      /* (M + 1) first row of each prototype */
    __global const int *targets,   /* (rows) what a row is for: a pixel, or from H * W on a cell */
    __global const int *starts,    /* (rows + 1) its first tap */
    __global const int *row_taps,  /* pixels, or from H * W on cells of rows before */
    __global const float *row_shares,
    __global const float *weights, /* (frames, M); a prototype without weight is not looked at */
    __global const int *pixels,    /* (P,) that are asked for */
    const int frames,
    const int number,              /* M */
    const int asked,               /* P */
    const int height,
    const int width,
    const int size,                /* of a pyramid */
    const int nodes,               /* H * W and cells of a prototype */
    const float hole,
    const int workers,
    const int first,
    const int count,
    /* outputs */
    __global float4 *total,        /* (workers, size) scratch */
    __global float2 *field,        /* (workers, nodes) scratch */
    __global float *mixed,         /* (frames, P, 3) */
    __global int *arrived)         /* (frames,) 0 where a prototype has nothing but holes */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    __global float4 *here = total + (first + tid) * size;
    __global float2 *there = field + (first + tid) * nodes;
    const int area = height * width;
    for (int job = first + tid; job < frames; job += workers) {
        __global float *out = mixed + 3 * job * asked;
        for (int i = 0; i < area; ++i)
            there[i] = flows[job * area + i];
        for (int i = 0; i < 3 * asked; ++i)
            out[i] = 0.0f;
        arrived[job] = 1;
        for (int m = 0; m < number; ++m) {
            const float weight = weights[job * number + m];
            if (weight == 0.0f)
                continue;
            move(m, images, fixed, taps, shares, rows, targets, starts, row_taps, row_shares,
                 height, width, there, here);
            int gaps = 0;
            for (int i = 0; i < asked; ++i) {
                const float4 sum = here[pixels[i]];
                if (sum.w >= hole)
                    vstore3(vload3(i, out) + weight * mean(sum, hole).xyz, i, out);
                else
                    ++gaps;
            }
            if (gaps == 0)
                continue;
            if (fill(here, height, width, hole) == 0)
                arrived[job] = 0;
            for (int i = 0; i < asked; ++i) {
                const int s = pixels[i];
                const float4 colour = between(here, height, width, s / width, s % width);
                if (here[s].w < hole)
                    vstore3(vload3(i, out) + weight * colour.xyz, i, out);
            }
        }
    }
}
