/* Pictures splatted along a flow into sums of a ring of rows.
 *
 * A pixel is added as two vectors of a pixel and the one right of it, in red, green, blue and weight.
 * A row of sums that no later pixel reaches can be shown (carrying); then its place is free again.
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
