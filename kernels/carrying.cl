/* Prototypes carried along a flow: splatted (rings), shown row by row, holes filled (pyramid).
 *
 * Pixels that received too little are listed when their row is shown, and filled later.
 */

/* Add to what is there, or begin it. */
void add(__global float *out, const float16 v, const int begun)
{
    put(out, begun ? get(out) + v : v);
}

/* Add half of the sums over blocks of 2 x 2, or begin them. */
void add_pairs(__global float *cell, const float16 v, const int more)
{
    const float8 sum = v.even + v.odd;
    *(__global float8u *)cell = more ? *(__global float8u *)cell + sum : sum;
}

/* Add the means of row y to a picture that is `begun`, or begin it; begin the pyramid.
 *
 * Channels of the picture are `apart` floats from each other. The sums are emptied. Pixels that are
 * asked for and received too little go to the list of holes, of which there are `found`. Returns how
 * many there are then.
 */
int show(__global float *total, const int y, const int h, const int w, const int pitch,
         const float hole, const float weight, __global const float *scale, const int begun,
         const int apart, __global float *out, __global float *cells, __global int *holes,
         int found)
{
    const int across = pitch_of((w + 1) / 2);
    const int step = (h + 1) / 2 * across;
    for (int x = 0; x < pitch; x += LANES) {
        __global float *t = total + COLOUR * (x + LEFT);
        const float16 a = get(t);
        const float16 b = get(t + LANES);
        const float16 c = get(t + 2 * LANES);
        const float16 d = get(t + 3 * LANES);
        for (int k = 0; k < COLOUR; ++k)
            put(t + LANES * k, (float16)0.0f);
        const float16 sum = (float16)(a.s37bf, b.s37bf, c.s37bf, d.s37bf);
        const float16 share = share_of(x + LANE < w ? sum : (float16)0.0f, hole);
        const float16 red = share * (float16)(a.s048c, b.s048c, c.s048c, d.s048c);
        const float16 green = share * (float16)(a.s159d, b.s159d, c.s159d, d.s159d);
        const float16 blue = share * (float16)(a.s26ae, b.s26ae, c.s26ae, d.s26ae);
        const int i = y * pitch + x;
        const float16 asked = get(scale + i);
        const int16 lacks = share == 0.0f & asked > 0.0f;
        if (least(lacks) < 0)
            for (int j = 0; j < LANES; ++j)
                if (lacks[j])
                    holes[found++] = i + j;
        const float16 part = weight * asked;
        add(out + i, part * red, begun);
        add(out + apart + i, part * green, begun);
        add(out + 2 * apart + i, part * blue, begun);
        __global float *cell = cells + y / 2 * across + x / 2;
        add_pairs(cell, red, y % 2);
        add_pairs(cell + step, green, y % 2);
        add_pairs(cell + 2 * step, blue, y % 2);
        add_pairs(cell + 3 * step, share > 0.0f ? (float16)1.0f : (float16)0.0f, y % 2);
    }
    return found;
}

/* Add to holes what is interpolated for them, where no cell is empty that it is made of, and all are
 * final: those of two rows below are shown, or all are.
 *
 * Returns how many holes are left; they are the first of the list then.
 */
int mend(__global int *holes, const int found, const int h, const int w, const int pitch,
         const int shown, const float weight, __global const float *scale,
         __global const float *cells, const int apart, __global float *out)
{
    int left = 0;
    for (int k = 0; k < found; ++k) {
        const int i = holes[k];
        const int y = i / pitch;
        const float4 colour = between(cells, h, w, y, i % pitch);
        if (colour.w < 1.0f || (y + 3 > shown && shown < h)) {
            holes[left++] = i;
            continue;
        }
        const float part = weight * scale[i];
        out[i] += part * colour.x;
        out[apart + i] += part * colour.y;
        out[2 * apart + i] += part * colour.z;
    }
    return left;
}

/* Carry a prototype on along a flow until the rows before `bottom` are shown.
 *
 * A state is how many rows of sums there are, the next row of the source, the next one to show, and
 * how many holes there are. Returns the next state.
 */
int4 carry_on(__global const ushort16 *texture, const int h, const int w, const int pitch,
              __global const float *right, __global const float *down, const float hole,
              const float weight, __global const float *scale, __global float *total,
              __global float *cells, __global const int *opens, __global int *places,
              __global float *steps, __global int *holes, const int4 state, const int bottom,
              const int begun, const int apart, __global float *out)
{
    const int ring = state.x;
    int y = state.y;
    int shown = state.z;
    int found = state.w;
    while (shown < bottom)
        if (shown < opens[y]) {
            found = show(total + (shown & (ring - 1)) * COLOUR * (pitch + MARGIN), shown, h, w,
                         pitch, hole, weight, scale, begun, apart, out, cells, holes, found);
            ++shown;
        } else {
            aim(texture + COLOUR * y * pitch / LANES, y, h, w, pitch, right + y * pitch,
                down + y * pitch, ring, places, steps);
            splat(pitch, places, steps, total);
            ++y;
        }
    return (int4)(ring, y, shown, found);
}

/* Add a prototype, carried along a flow, to a picture that is `begun`, or begin it.
 *
 * Returns 0 where nothing of it arrives.
 */
int carry(__global const ushort16 *texture, const int h, const int w, const int pitch,
          __global const float *right, __global const float *down, const float hole,
          const float weight, __global const float *scale, __global float *total,
          __global float *cells, __global int *opens, __global int *places, __global float *steps,
          __global int *holes, const int begun, __global float *out)
{
    const int4 state = (int4)(reach(down, h, pitch, opens), 0, 0, 0);
    const int found = carry_on(texture, h, w, pitch, right, down, hole, weight, scale, total, cells,
                               opens, places, steps, holes, state, h, begun, h * pitch, out).w;
    if (found == 0)
        return 1;
    if (fill(cells, (h + 1) / 2, (w + 1) / 2) == 0)
        return 0;
    mend(holes, found, h, w, pitch, h, weight, scale, cells, h * pitch, out);
    return 1;
}
