/* Prototypes moved along flows of the model and mixed: CE05, Eq. 2 in one launch.
 *
 * The flow that is missing to a prototype, carried to its pixels, is a fixed sparse mean of the
 * model's flow less a fixed flow (see mmmgpu/backends/orientation.py). Along it the pixels are
 * splatted into an accumulator that belongs to the worker alone. What received too little is filled
 * by pull-push, where such a pixel is asked for.
 *
 * Everything is done for 16 neighbours of a row at a time: those of them that move by the same whole
 * number of pixels are neighbours again where they arrive. So pictures are planes, one a channel,
 * and their rows are padded to whole vectors; a padded row is a pitch.
 */

#pragma OPENCL FP_CONTRACT OFF

#include "lanes.cl"
#include "pyramid.cl"

#define NONE 2147483647 /* where a pixel that arrives nowhere goes */
#define WHITE 65535.0f  /* the brightest value of a texture */

/* Where the vector begins with which each pixel arrives at (x, y). */
int16 starts_of(const int16 x, const int16 y, const int h, const int w, const int pitch)
{
    const int16 reaches = x >= -1 & x < w & y >= -1 & y < h;
    return reaches ? y * pitch + x - LANE : (int16)NONE;
}

/* Add one channel of a vector to the two rows on which it arrives. */
void add_rows(__global float *t, const int pitch, const float16 upper_left,
              const float16 upper_right, const float16 lower_left, const float16 lower_right)
{
    put(t, get(t) + (upper_left + one_later(upper_right)));
    put(t + pitch, get(t + pitch) + (lower_left + one_later(lower_right)));
}

/* Add what the last pixel of a vector gives to the column right of it. */
void add_last(__global float *t, const int pitch, const float upper, const float lower)
{
    t[0] += upper;
    t[pitch] += lower;
}

/* The flow that is missing to prototype m, for each of its pixels. */
void orient(const int m, __global const float *fixed, __global const int *firsts,
            __global const int *deltas, __global const float *shares, __global const int *rows,
            __global const int *targets, __global const int *starts, __global const int *row_taps,
            __global const float *row_shares, const int area, const int nodes,
            __global float *field, __global float *residual)
{
    const int vectors = area / LANES;
    fixed += 2 * m * area;
    for (int v = 0; v < vectors; ++v) {
        const int i = LANES * v;
        float16 x = -get(fixed + i);
        float16 y = -get(fixed + area + i);
        for (int k = firsts[m * vectors + v]; k < firsts[m * vectors + v + 1]; ++k) {
            __global const float *at = field + i + deltas[k];
            const float16 share = get(shares + LANES * k);
            x += share * get(at);
            y += share * get(at + nodes);
        }
        put(residual + i, x);
        put(residual + area + i, y);
    }
    for (int row = rows[m]; row < rows[m + 1]; ++row) {
        float right = 0.0f;
        float down = 0.0f;
        for (int j = starts[row]; j < starts[row + 1]; ++j) {
            right += row_shares[j] * field[row_taps[j]];
            down += row_shares[j] * field[row_taps[j] + nodes];
        }
        const int s = targets[row];
        if (s < area) {
            residual[s] = right - fixed[s];
            residual[area + s] = down - fixed[area + s];
        } else {
            field[s] = right;
            field[nodes + s] = down;
        }
    }
}

/* Carry the pixels of prototype m, each to the four around where it arrives. */
void splat(const int m, __global const ushort16 *textures, const int h, const int w,
           const int pitch, __global const float *residual, __global float *total, const int step)
{
    const int area = h * pitch;
    const int vectors = area / LANES;
    textures += 3 * m * vectors;
    for (int v = 0; v < vectors; ++v) {
        const int i = LANES * v;
        const float16 qx = within_reach(get(residual + i));
        const float16 qy = within_reach(get(residual + area + i));
        const int16 right = whole(qx);
        const int16 down = whole(qy);
        const float16 fx = qx - convert_float16(right);
        const float16 fy = qy - convert_float16(down);
        const int16 x = right + LANE + i % pitch;
        const int16 y = down + i / pitch;
        const float16 left_share = inside(1.0f - fx, x, w);
        const float16 right_share = inside(fx, x + 1, w);
        const float16 upper_share = inside(1.0f - fy, y, h);
        const float16 lower_share = inside(fy, y + 1, h);
        const float16 upper_left = left_share * upper_share;
        const float16 upper_right = right_share * upper_share;
        const float16 lower_left = left_share * lower_share;
        const float16 lower_right = right_share * lower_share;
        const float16 red = convert_float16(textures[v]);
        const float16 green = convert_float16(textures[v + vectors]);
        const float16 blue = convert_float16(textures[v + 2 * vectors]);
        int16 start = starts_of(x, y, h, w, pitch);
        if (start.sf != NONE) {
            __global float *t = total + start.sf + LANES;
            const float a = upper_right.sf;
            const float b = lower_right.sf;
            add_last(t, pitch, a * red.sf, b * red.sf);
            add_last(t + step, pitch, a * green.sf, b * green.sf);
            add_last(t + 2 * step, pitch, a * blue.sf, b * blue.sf);
            add_last(t + 3 * step, pitch, a, b);
        }
        int first = least(start);
        while (first != NONE) {
            const int16 same = start == first;
            const float16 a00 = same ? upper_left : (float16)0.0f;
            const float16 a10 = same ? upper_right : (float16)0.0f;
            const float16 a01 = same ? lower_left : (float16)0.0f;
            const float16 a11 = same ? lower_right : (float16)0.0f;
            __global float *t = total + first;
            add_rows(t, pitch, a00 * red, a10 * red, a01 * red, a11 * red);
            add_rows(t + step, pitch, a00 * green, a10 * green, a01 * green, a11 * green);
            add_rows(t + 2 * step, pitch, a00 * blue, a10 * blue, a01 * blue, a11 * blue);
            add_rows(t + 3 * step, pitch, a00, a10, a01, a11);
            start = same ? (int16)NONE : start;
            first = least(start);
        }
    }
}

/* The least weight at a pixel that is asked for. */
float least_asked(__global const float *weight, const int area, __global const float *scale)
{
    float16 low = (float16)HUGE;
    for (int i = 0; i < area; i += LANES) {
        const float16 n = get(weight + i);
        low = (get(scale + i) > 0.0f & n < low) ? n : low;
    }
    return least_value(low);
}

/* From sums to means and a weight of 1, and nothing in holes. */
void normalise(__global float *total, const int step, const int area, const float hole)
{
    for (int i = 0; i < area; i += LANES) {
        const float16 share = share_of(get(total + 3 * step + i), hole);
        for (int c = 0; c < 4; ++c) {
            __global float *at = total + c * step + i;
            put(at, share * get(at));
        }
    }
}

/* Write the means, or add them, and empty the accumulator. */
void show(__global float *total, const int step, const int area, const float hole,
          const float weight, __global const float *scale, const int more, __global float *out)
{
    for (int i = 0; i < area; i += LANES) {
        const float16 share = weight * (get(scale + i) * share_of(get(total + 3 * step + i), hole));
        for (int c = 0; c < 3; ++c) {
            __global float *at = total + c * step + i;
            float16 colour = share * get(at);
            if (more)
                colour += get(out + c * area + i);
            put(out + c * area + i, colour);
            put(at, (float16)0.0f);
        }
        put(total + 3 * step + i, (float16)0.0f);
    }
}

__kernel void mix_prototypes(
    __global const float *flows,       /* (frames, 2, H, pitch) [px]; frames: 1 or the mixtures */
    __global const ushort16 *textures, /* (M, 3, H, pitch) of 65535 */
    __global const float *fixed,       /* (M, 2, H, pitch) [px] taken off the mean of a flow */
    __global const int *firsts,        /* (M * H * pitch / 16 + 1) first part of a vector's means */
    __global const int *deltas,        /* (parts) how much further on in the flow a part lies */
    __global const float *shares,      /* (parts, 16) the pixels' shares in it */
    __global const int *rows,          /* (M + 1) first row of each prototype */
    __global const int *targets,       /* (rows) a pixel, or from H * pitch + 16 on a cell */
    __global const int *starts,        /* (rows + 1) its first tap */
    __global const int *row_taps,      /* pixels or cells, of rows before */
    __global const float *row_shares,
    __global const int *parts,         /* (mixtures + 1) first member of each mixture */
    __global const int *members,       /* (parts[mixtures]) prototypes */
    __global const float *weights,     /* (parts[mixtures]) their weights */
    __global const float *scale,       /* (H, pitch) of what is written; 0 where nothing is asked */
    const int frames,
    const int mixtures,
    const int height,
    const int width,
    const int size,                    /* of a pyramid without its finest level */
    const int nodes,                   /* 16, pixels, 16, and cells of a prototype */
    const float hole,
    const int workers,
    const int first,
    const int count,
    /* outputs */
    __global float *total,             /* (workers, 4, H * pitch + 2 (pitch + 32)) scratch: sums */
    __global float *cells,             /* (workers, 4 size) scratch */
    __global float *field,             /* (workers, 2, nodes) scratch */
    __global float *residual,          /* (workers, 2, H, pitch) scratch */
    __global float *mixed,             /* (mixtures, 3, H, pitch) */
    __global int *arrived)             /* (mixtures,) 0 where a prototype has nothing but holes */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int worker = first + tid;
    const int pitch = pitch_of(width);
    const int area = height * pitch;
    const int step = area + 2 * (pitch + 2 * LANES);
    total += 4 * worker * step;
    cells += 4 * worker * size;
    field += 2 * worker * nodes;
    residual += 2 * worker * area;
    for (int i = 0; i < 4 * step; ++i)
        total[i] = 0.0f;
    for (int i = 0; i < 2 * nodes; ++i)
        field[i] = 0.0f;
    total += pitch + 2 * LANES;
    field += LANES;
    for (int job = worker; job < mixtures; job += workers) {
        __global float *out = mixed + 3 * job * area;
        if (frames > 1 || job == worker)
            for (int i = 0; i < area; ++i) {
                field[i] = flows[2 * (job % frames) * area + i];
                field[nodes + i] = flows[(2 * (job % frames) + 1) * area + i];
            }
        arrived[job] = 1;
        if (parts[job] == parts[job + 1])
            for (int i = 0; i < 3 * area; ++i)
                out[i] = 0.0f;
        for (int part = parts[job]; part < parts[job + 1]; ++part) {
            orient(members[part], fixed, firsts, deltas, shares, rows, targets, starts, row_taps,
                   row_shares, area, nodes, field, residual);
            splat(members[part], textures, height, width, pitch, residual, total, step);
            if (least_asked(total + 3 * step, area, scale) < hole) {
                normalise(total, step, area, hole);
                const int some = fill(total, step, height, width, scale, cells);
                arrived[job] = some < arrived[job] ? some : arrived[job];
            }
            show(total, step, area, hole, weights[part] / WHITE, scale, part > parts[job], out);
        }
    }
}
