/* Pull-push hole filling of planes: red, green, blue and weight, one after the other.
 *
 * Of the pixels, means have a weight of 1, and holes none; the levels hold sums over blocks of them. A
 * cell without weight is interpolated from the next coarser level.
 */

/* The level after one of h x w: sums over blocks of 2 x 2. Returns the least weight of all. */
float pull(__global const float *fine, const int step, const int h, const int w,
           __global float *cells)
{
    const int pitch = pitch_of(w);
    const int columns = (w + 1) / 2;
    const int across = pitch_of(columns);
    const int rows = (h + 1) / 2;
    float16 low = (float16)HUGE;
    for (int y = 0; y < rows; ++y)
        for (int x = 0; x < across; x += LANES) {
            float16 sum = (float16)0.0f;
            for (int c = 0; c < 4; ++c) {
                __global const float *from = fine + c * step + 2 * y * pitch + 2 * x;
                float16 left = get(from);
                float16 right = (float16)0.0f;
                if (2 * y + 1 < h)
                    left += get(from + pitch);
                if (2 * x + LANES < pitch) {
                    right = get(from + LANES);
                    if (2 * y + 1 < h)
                        right += get(from + pitch + LANES);
                }
                sum = pairs(left, right);
                put(cells + (c * rows + y) * across + x, sum);
            }
            low = (x + LANE < columns & sum < low) ? sum : low;
        }
    return least_value(low);
}

/* Of a cell; the fourth is 1, or 0 where it is empty. */
float4 mean(__global const float *cells, const int i, const int step)
{
    const float n = cells[i + 3 * step];
    const float known = n > 0.0f ? 1.0f : 0.0f;
    const float share = n > 0.0f ? 1.0f / n : 0.0f; /* n times it may be less than 1 on a GPU */
    return (float4)(share * cells[i], share * cells[i + step], share * cells[i + 2 * step], known);
}

/* The pixel (x, y) of a level of h x w, interpolated from four cells of the next one.
 *
 * The fourth is 1, or less where one of the four is empty.
 */
float4 between(__global const float *coarse, const int h, const int w, const int y, const int x)
{
    const int columns = (w + 1) / 2;
    const int rows = (h + 1) / 2;
    const int across = pitch_of(columns);
    const int step = rows * across;
    const int x0 = x / 2;
    const int side = x0 + 2 * (x % 2) - 1;
    const int x1 = side < 0 ? 0 : side < columns ? side : columns - 1;
    const int y0 = y / 2 * across;
    const int above = y / 2 + 2 * (y % 2) - 1;
    const int y1 = (above < 0 ? 0 : above < rows ? above : rows - 1) * across;
    const float4 near = 0.75f * mean(coarse, y0 + x0, step) + 0.25f * mean(coarse, y0 + x1, step);
    const float4 far = 0.75f * mean(coarse, y1 + x0, step) + 0.25f * mean(coarse, y1 + x1, step);
    return 0.75f * near + 0.25f * far;
}

/* Give an empty cell a colour, and the weight of one pixel. */
void set_cell(__global float *cells, const int i, const int step, const float4 colour)
{
    cells[i] = colour.x;
    cells[i + step] = colour.y;
    cells[i + 2 * step] = colour.z;
    cells[i + 3 * step] = 1.0f;
}

/* Push: fill the empty cells of some levels, of which the last has none. */
void complete(__global float *cells, const int height, const int width, const int levels)
{
    for (int up = 1; up < levels; ++up) {
        int h = height;
        int w = width;
        __global float *at = cells;
        for (int level = 0; level < levels - 1 - up; ++level) {
            at += 4 * h * pitch_of(w);
            h = (h + 1) / 2;
            w = (w + 1) / 2;
        }
        const int pitch = pitch_of(w);
        const int step = h * pitch;
        for (int y = 0; y < h; ++y)
            for (int first = 0; first < w; first += LANES)
                if (least_value(get(at + 3 * step + y * pitch + first)) == 0.0f)
                    for (int x = first; x < first + LANES && x < w; ++x) {
                        const int i = y * pitch + x;
                        if (at[i + 3 * step] == 0.0f)
                            set_cell(at, i, step, between(at + 4 * step, h, w, y, x));
                    }
    }
}

/* The least weight of a cell of the first level. */
float least_weight(__global const float *weight, const int h, const int w)
{
    const int pitch = pitch_of(w);
    float16 low = (float16)HUGE;
    for (int y = 0; y < h; ++y)
        for (int x = 0; x < pitch; x += LANES) {
            const float16 n = get(weight + y * pitch + x);
            low = (x + LANE < w & n < low) ? n : low;
        }
    return least_value(low);
}

/* Pull-push of a level of h x w cells. Returns 0 of nothing but holes.
 *
 * Levels are made until one has no empty cell.
 */
int fill(__global float *cells, const int height, const int width)
{
    int h = height;
    int w = width;
    float low = least_weight(cells + 3 * h * pitch_of(w), h, w);
    __global float *at = cells;
    int levels = 1;
    while (low == 0.0f && (h > 1 || w > 1)) {
        const int plane = h * pitch_of(w);
        low = pull(at, plane, h, w, at + 4 * plane);
        at += 4 * plane;
        h = (h + 1) / 2;
        w = (w + 1) / 2;
        ++levels;
    }
    if (low == 0.0f)
        return 0;
    complete(cells, height, width, levels);
    return 1;
}
