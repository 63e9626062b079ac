/* Prototypes moved along flows of the model and mixed: CE05, Eq. 2 in one launch.
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

/* Splat all pixels of prototype m; nothing is in the accumulator. */
void move(const int m, __global const float4 *images, __global const float2 *fixed,
          __global const int *taps, __global const float *shares, __global const int *rows,
          __global const int *targets, __global const int *starts, __global const int *row_taps,
          __global const float *row_shares, const int h, const int w, __global float2 *field,
          __global float4 *total)
{
    const int area = h * w;
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
    return sum.w >= least ? (float4)(1.0f / sum.w * sum.xyz, 1.0f) : (float4)(0.0f);
}

/* The pixel (x, y) of a level of h x w, interpolated from the next one, which is complete. */
float4 between(__global const float4 *coarse, const int h, const int w, const int y, const int x)
{
    const int columns = (w + 1) / 2;
    const int x0 = x / 2;
    const int x1 = clamp(x0 + 2 * (x % 2) - 1, 0, columns - 1);
    __global const float4 *y0 = coarse + y / 2 * columns;
    __global const float4 *y1 = coarse + clamp(y / 2 + 2 * (y % 2) - 1, 0, (h - 1) / 2) * columns;
    const float4 near = 0.75f * y0[x0] + 0.25f * y0[x1];
    const float4 far = 0.75f * y1[x0] + 0.25f * y1[x1];
    return 0.75f * near + 0.25f * far;
}

/* The level after this one of h x w: sums over blocks of 2 x 2. */
void pull(__global float4 *fine, const int h, const int w)
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
            const float4 sum = upper[left] + upper[right] + (lower[left] + lower[right]);
            const float share = left + 1 < w ? twice : 0.5f * twice;
            coarse[y * columns + x] = share * sum;
        }
    }
}

/* Pull-push of a level of sums and all that follow. Returns the sum of all weights. */
int fill(__global float4 *cells, const int height, const int width)
{
    int h = height;
    int w = width;
    __global float4 *at = cells;
    int levels = 1;
    while (h > 1 || w > 1) {
        pull(at, h, w);
        at += h * w;
        h = (h + 1) / 2;
        w = (w + 1) / 2;
        ++levels;
    }
    const int number = (int)at[0].w;
    for (int up = 0; up < levels; ++up) {
        h = height;
        w = width;
        at = cells;
        for (int level = 0; level < levels - 1 - up; ++level) {
            at += h * w;
            h = (h + 1) / 2;
            w = (w + 1) / 2;
        }
        for (int y = 0; y < h; ++y)
            for (int x = 0; x < w; ++x) {
                const int i = y * w + x;
                if (at[i].w > 0.0f)
                    at[i] = mean(at[i], 1.0f);
                else if (up > 0)
                    at[i] = between(at + h * w, h, w, y, x);
            }
    }
    return number;
}

/* Write a colour, or add it. */
void show(__global float *out, const int i, const float4 colour, const int more)
{
    if (more)
        vstore3(vload3(i, out) + colour.xyz, i, out);
    else
        vstore3(colour.xyz, i, out);
}

/* Show what arrived, and what is filled, at pixels that have a place; empty the accumulator.
 *
 * Returns 0 where nothing arrived.
 */
int settle(__global float4 *total, const int h, const int w, const float hole,
           __global const int *places, __global const float *scale, const float weight,
           const int more, __global float *out, __global float4 *cells, __global int *holes)
{
    const int columns = (w + 1) / 2;
    int gaps = 0;
    for (int y = 0; y < (h + 1) / 2; ++y)
        for (int x = 0; x < columns; ++x) {
            float4 block = (float4)(0.0f);
            for (int tap = 0; tap < 4; ++tap) {
                const int ty = 2 * y + tap / 2;
                const int tx = 2 * x + tap % 2;
                if (ty >= h || tx >= w)
                    continue;
                const int i = ty * w + tx;
                const float4 colour = mean(total[i], hole);
                total[i] = (float4)(0.0f);
                block += colour;
                if (places[i] < 0)
                    continue;
                if (colour.w > 0.0f)
                    show(out, places[i], weight * scale[i] * colour, more);
                else
                    holes[gaps++] = i;
            }
            cells[y * columns + x] = block;
        }
    if (gaps == 0)
        return 1;
    const int number = fill(cells, (h + 1) / 2, columns);
    for (int j = 0; j < gaps; ++j) {
        const int i = holes[j];
        const float4 colour = between(cells, h, w, i / w, i % w);
        show(out, places[i], weight * scale[i] * colour, more);
    }
    return number;
}

__kernel void mix_prototypes(
    __global const float2 *flows,  /* (frames, H * W) [px], frames is 1 or the mixtures */
    __global const float4 *images, /* (M, H * W), weight 1 */
    __global const float2 *fixed,  /* (M, H * W) [px] taken off the mean of a flow */
    __global const int *taps,      /* (M, H * W, 6) pixels of the mean; first -1: own row */
    __global const float *shares,  /* (M, H * W, 6) their shares */
    __global const int *rows,      /* (M + 1) first row of each prototype */
    __global const int *targets,   /* (rows) what a row is for: a pixel, or from H * W on a cell */
    __global const int *starts,    /* (rows + 1) its first tap */
    __global const int *row_taps,  /* pixels, or from H * W on cells of rows before */
    __global const float *row_shares,
    __global const int *parts,     /* (mixtures + 1) first member of each mixture */
    __global const int *members,   /* (parts[mixtures]) prototypes */
    __global const float *weights, /* (parts[mixtures]) their weights */
    __global const int *places,    /* (H * W) where a pixel is written, -1 for nowhere */
    __global const float *scale,   /* (H * W) of what is written */
    const int frames,
    const int mixtures,
    const int asked,               /* P places */
    const int height,
    const int width,
    const int size,                /* of a pyramid without its finest level */
    const int nodes,               /* H * W and cells of a prototype */
    const float hole,
    const int workers,
    const int first,
    const int count,
    /* outputs */
    __global float4 *total,        /* (workers, H * W) scratch */
    __global float4 *cells,        /* (workers, size) scratch */
    __global int *holes,           /* (workers, H * W) scratch */
    __global float2 *field,        /* (workers, nodes) scratch */
    __global float *mixed,         /* (mixtures, P, 3) */
    __global int *arrived)         /* (mixtures,) 0 where a prototype has nothing but holes */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int worker = first + tid;
    const int area = height * width;
    total += worker * area;
    cells += worker * size;
    holes += worker * area;
    field += worker * nodes;
    for (int i = 0; i < area; ++i)
        total[i] = (float4)(0.0f);
    for (int job = worker; job < mixtures; job += workers) {
        __global float *out = mixed + 3 * job * asked;
        if (frames > 1 || job == worker)
            for (int i = 0; i < area; ++i)
                field[i] = flows[job % frames * area + i];
        arrived[job] = 1;
        if (parts[job] == parts[job + 1])
            for (int i = 0; i < 3 * asked; ++i)
                out[i] = 0.0f;
        for (int part = parts[job]; part < parts[job + 1]; ++part) {
            move(members[part], images, fixed, taps, shares, rows, targets, starts, row_taps,
                 row_shares, height, width, field, total);
            const int number = settle(total, height, width, hole, places, scale, weights[part],
                                      part > parts[job], out, cells, holes);
            arrived[job] = min(arrived[job], number);
        }
    }
}
