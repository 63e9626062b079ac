/* Bilinear gather with the border clamped. */

__kernel void sample(
    __global const float *field,   /* (fields, H, W, C), fields is 1 or the batch */
    __global const float *points,  /* (sets, N, 2) = (x, y) [px], sets is 1 or the batch */
    const int fields,
    const int sets,
    const int number,              /* N */
    const int height,
    const int width,
    const int channels,
    const int first,
    const int count,
    /* outputs */
    __global float *sampled)       /* (batch, N, C) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int i = first + tid;
    const int b = i / number;
    const int p = (b % sets) * number + i % number;
    const float x = clamp(points[2 * p], 0.0f, (float)(width - 1));
    const float y = clamp(points[2 * p + 1], 0.0f, (float)(height - 1));
    const int x0 = (int)x;
    const int y0 = (int)y;
    const float fx = x - x0;
    const float fy = y - y0;
    const int x1 = min(x0 + 1, width - 1);
    const int y1 = min(y0 + 1, height - 1);
    const int near = ((b % fields) * height + y0) * width;
    const int far = ((b % fields) * height + y1) * width;
    for (int c = 0; c < channels; ++c) {
        float a0 = (1.0f - fx) * field[(near + x0) * channels + c];
        a0 += fx * field[(near + x1) * channels + c];
        float a1 = (1.0f - fx) * field[(far + x0) * channels + c];
        a1 += fx * field[(far + x1) * channels + c];
        sampled[i * channels + c] = (1.0f - fy) * a0 + fy * a1;
    }
}
