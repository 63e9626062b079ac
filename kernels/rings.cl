/* Pictures splatted along a flow into sums of a ring of rows, and shown row by row.
 *
 * A pixel is added as two vectors of a pixel and the one right of it, in red, green, blue and weight.
 * A row of sums that no later pixel reaches is shown, and its place is free for another. Pixels that
 * received too little are listed, and filled by pull-push in the end.
 */

#define APART 4       /* between pixels splatted in turn: neighbours would wait for each other */
#define COLOUR 4      /* floats of a pixel: red, green, blue, weight */
#define LEFT 4        /* pixels of a row of sums before the picture; the first two are nowhere */
#define MARGIN 40     /* pixels of a row of sums beside the picture */

#define UP_TO ((float8)(1.0f, 1.0f, 1.0f, 1.0f, 0.0f, 0.0f, 0.0f, 0.0f))
#define RISES ((float8)(-1.0f, -1.0f, -1.0f, -1.0f, 1.0f, 1.0f, 1.0f, 1.0f))

/* Rows of sums that are needed at once.
 *
 * Row y of the source and those after it reach no row before opens[y].
 */
int reach(__global const float *down, const int h, const int pitch, __global int *opens)
{
    int open = h;
    int most = 1;
    opens[h] = h;
    for (int y = h - 1; y >= 0; --y) {
        const float16 above = (float16)(-1 - y);
        const float16 below = (float16)(h - y);
        float16 low = below;
        float16 high = above;
        for (int x = 0; x < pitch; x += LANES) {
            const float16 q = get(down + y * pitch + x);
            low = (q >= above & q < low) ? q : low;
            high = (q < below & q > high) ? q : high;
        }
        const int from = y + least(whole(low));
        const int to = y - least(-whole(high));
        const int first = from < 0 ? 0 : from;
        const int last = to < h - 1 ? to + 1 : h - 1;
        open = first < open ? first : open;
        most = last - open < most ? most : last - open + 1;
        opens[y] = open;
    }
    int ring = 1;
    while (ring < most)
        ring *= 2;
    return ring;
}

/* Where the pixels of row y arrive, how far between pixels, and which colours they have. */
void aim(__global const ushort16 *texture, const int y, const int h, const int w, const int pitch,
         __global const float *right, __global const float *down, const int ring,
         __global int *places, __global float *steps)
{
    const int row = COLOUR * (pitch + MARGIN);
    __global float *colours = steps + 3 * pitch;
    for (int i = 0; i < pitch; i += LANES) {
        const float16 qx = within_reach(get(right + i));
        const float16 qy = within_reach(get(down + i));
        const int16 nx = whole(qx);
        const int16 ny = whole(qy);
        const float16 fy = qy - convert_float16(ny);
        put(steps + i, qx - convert_float16(nx));
        put(steps + pitch + i, 1.0f - fy);
        put(steps + 2 * pitch + i, fy);
        const int16 x = nx + LANE + i;
        const int16 above = ny + y;
        const int16 below = above + 1;
        const int16 column = COLOUR * (x + LEFT);
        const int16 across = x >= -1 & x < w; /* what pads a row is not moved */
        const int16 starts = above >= 0 & above < h;
        const int16 ends = below >= 0 & below < h;
        const int16 upper = (above & (ring - 1)) * row + column;
        const int16 lower = (below & (ring - 1)) * row + column;
        put_whole(places + i, across & starts ? upper : (int16)0);
        put_whole(places + pitch + i, across & ends ? lower : (int16)0);
        for (int k = 0; k < COLOUR; ++k)
            put(colours + COLOUR * i + LANES * k, convert_float16(texture[COLOUR * i / LANES + k]));
    }
}

/* Add the pixels of a row, each to the four around where it arrives. */
void splat(const int pitch, __global const int *places, __global const float *steps,
           __global float *total)
{
    __global const float *colours = steps + 3 * pitch;
    for (int from = 0; from < APART; ++from)
        for (int i = from; i < pitch; i += APART) {
            const float4 colour = *(__global const float4u *)(colours + COLOUR * i);
            const float8 both = (float8)(colour, colour) * (UP_TO + RISES * steps[i]);
            __global float8u *upper = (__global float8u *)(total + places[i]);
            *upper += both * steps[pitch + i];
            __global float8u *lower = (__global float8u *)(total + places[pitch + i]);
            *lower += both * steps[2 * pitch + i];
        }
}

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
 * Their sums are emptied. Pixels that are asked for and received too little go to the list of holes,
 * of which there are `found`. Returns how many there are then.
 */
int show(__global float *total, const int y, const int h, const int w, const int pitch,
         const float hole, const float weight, __global const float *scale, const int begun,
         __global float *out, __global float *cells, __global int *holes, int found)
{
    const int area = h * pitch;
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
        add(out + area + i, part * green, begun);
        add(out + 2 * area + i, part * blue, begun);
        __global float *cell = cells + y / 2 * across + x / 2;
        add_pairs(cell, red, y % 2);
        add_pairs(cell + step, green, y % 2);
        add_pairs(cell + 2 * step, blue, y % 2);
        add_pairs(cell + 3 * step, share > 0.0f ? (float16)1.0f : (float16)0.0f, y % 2);
    }
    return found;
}

/* Add to some pixels what is interpolated for them. */
void mend(__global const int *holes, const int found, const int h, const int w, const int pitch,
          const float weight, __global const float *scale, __global const float *cells,
          __global float *out)
{
    for (int k = 0; k < found; ++k) {
        const int i = holes[k];
        const float4 colour = weight * scale[i] * between(cells, h, w, i / pitch, i % pitch);
        out[i] += colour.x;
        out[h * pitch + i] += colour.y;
        out[2 * h * pitch + i] += colour.z;
    }
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
    const int ring = reach(down, h, pitch, opens);
    int shown = 0;
    int found = 0;
    for (int y = 0; y <= h; ++y) {
        for (; shown < opens[y]; ++shown)
            found = show(total + (shown & (ring - 1)) * COLOUR * (pitch + MARGIN), shown, h, w,
                         pitch, hole, weight, scale, begun, out, cells, holes, found);
        if (y < h) {
            aim(texture + COLOUR * y * pitch / LANES, y, h, w, pitch, right + y * pitch,
                down + y * pitch, ring, places, steps);
            splat(pitch, places, steps, total);
        }
    }
    if (found == 0)
        return 1;
    if (fill(cells, (h + 1) / 2, (w + 1) / 2) == 0)
        return 0;
    mend(holes, found, h, w, pitch, weight, scale, cells, out);
    return 1;
}
