/* Pull-push hole filling: valid pixels are averaged down a pyramid, holes interpolated back up.
 *
 * A cell is valid where its weight reaches the threshold. A coarse cell holds the mean of the valid
 * pixels of its block, and their number as its weight; one without any is interpolated from the
 * level above it. Every work-item takes one row.
 */

__kernel void count_valid(
    __global const float *weight,  /* (batch * H, W) */
    const float threshold,
    const int width,
    const int first,
    const int count,
    /* outputs */
    __global int *valid)           /* (batch * H,) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int row = first + tid;
    int n = 0;
    for (int x = 0; x < width; ++x)
        n += weight[row * width + x] >= threshold;
    valid[row] = n;
}

/* Number of valid pixels in a cell; in the finest level weights are not numbers yet. */
float share(const float weight, const float threshold, const int finest)
{
    if (weight < threshold)
        return 0.0f;
    return finest ? 1.0f : weight;
}

__kernel void pull(
    __global const int *holes,     /* (batch,) 0 where an image has no holes: it has no levels */
    __global const float *value,   /* (batch, h, w, C), a level */
    __global const float *weight,  /* (batch, h, w) */
    const float threshold,
    const int finest,
    const int height,              /* h */
    const int width,               /* w */
    const int channels,
    const int first,
    const int count,
    /* outputs */
    __global float *filled,        /* (batch, h, w, C), in the finest level the valid are written */
    __global float *coarse,        /* (batch, ceil(h / 2), ceil(w / 2), C) */
    __global float *number)        /* (batch, ceil(h / 2), ceil(w / 2)), valid pixels in the block */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int rows = (height + 1) / 2;
    const int columns = (width + 1) / 2;
    const int b = (first + tid) / rows;
    const int y = 2 * ((first + tid) % rows);
    const int upper = (b * height + y) * width;
    if (finest) {
        const int end = (upper + (y + 1 < height ? 2 : 1) * width) * channels;
        for (int i = upper * channels; i < end; ++i)
            filled[i] = value[i];
    }
    if (holes[b] == 0)
        return;
    const int lower = (b * height + min(y + 1, height - 1)) * width;
    for (int column = 0; column < columns; ++column) {
        const int x = 2 * column;
        const int right = x + 1 < width ? x + 1 : x; /* min would be a call */
        float n00 = share(weight[upper + x], threshold, finest);
        float n01 = share(weight[upper + right], threshold, finest);
        float n10 = share(weight[lower + x], threshold, finest);
        float n11 = share(weight[lower + right], threshold, finest);
        if (x + 1 >= width)
            n01 = n11 = 0.0f;
        if (y + 1 >= height)
            n10 = n11 = 0.0f;
        const float n = n00 + n01 + n10 + n11;
        const float scale = n > 0.0f ? 1.0f / n : 0.0f;
        const int cell = (first + tid) * columns + column;
        number[cell] = n;
        for (int c = 0; c < channels; ++c) {
            float total = n00 * value[(upper + x) * channels + c];
            total += n01 * value[(upper + right) * channels + c];
            total += n10 * value[(lower + x) * channels + c];
            total += n11 * value[(lower + right) * channels + c];
            coarse[cell * channels + c] = total * scale;
        }
    }
}

__kernel void push(
    __global const int *holes,     /* (batch,) 0 where an image has no holes: it is skipped */
    __global const float *weight,  /* (batch, h, w) */
    __global const float *coarse,  /* (batch, ceil(h / 2), ceil(w / 2), C), complete */
    const float threshold,
    const int height,              /* h */
    const int width,               /* w */
    const int channels,
    const int first,
    const int count,
    /* outputs */
    __global float *value)         /* (batch, h, w, C), its holes are written */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int rows = (height + 1) / 2;
    const int columns = (width + 1) / 2;
    const int row = first + tid;
    const int b = row / height;
    if (holes[b] == 0)
        return;
    const int y = row % height;
    /* a pixel lies 1/4 from the centre of its own cell towards the next cell on its side */
    const int y1 = clamp(y / 2 + 2 * (y % 2) - 1, 0, rows - 1);
    const int near = (b * rows + y / 2) * columns;
    const int far = (b * rows + y1) * columns;
    for (int x = 0; x < width; ++x) {
        const int i = row * width + x;
        if (weight[i] >= threshold)
            continue;
        const int x0 = x / 2;
        const int x1 = clamp(x0 + 2 * (x % 2) - 1, 0, columns - 1);
        for (int c = 0; c < channels; ++c) {
            float a0 = 0.75f * coarse[(near + x0) * channels + c];
            a0 += 0.25f * coarse[(near + x1) * channels + c];
            float a1 = 0.75f * coarse[(far + x0) * channels + c];
            a1 += 0.25f * coarse[(far + x1) * channels + c];
            value[i * channels + c] = 0.75f * a0 + 0.25f * a1;
        }
    }
}
