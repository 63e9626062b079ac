/* The residual flow of a prototype, carried to its pixels: W_F(C_syn - C_i, C_i) of CE05, Eq. 2.
 *
 * It is a mean over neighbours that are always the same (see mmmgpu/backends/orientation.py), made for
 * vectors of 16 pixels of a row. Shares follow from C_i: kept ones would take more time to read.
 */

/* How much of what arrives `off` pixels away a pixel gets. */
float16 near(const float16 off)
{
    return 1.0f - as_float16(as_int16(off) & 0x7fffffff);
}

/* The flow that is missing to prototype m, for each of its pixels, in 1, 2 or 4 frames.
 *
 * Shares of what is wanted and of the prototype's own flow are added apart: each is one instruction.
 */
void orient(const int m, __global const float *own, __global const float *shares,
            __global const int *firsts, __global const int *neighbours, __global const int *rows,
            __global const int *targets, __global const int *starts, __global const int *row_taps,
            __global const float *row_shares, const int area, const int pitch, const int nodes,
            const int together, __global const float *field, __global float *residual)
{
    const int vectors = area / LANES;
    const int frame = 2 * (area + LANES);
    own += 2 * m * area;
    shares += m * area;
    firsts += m * vectors;
    for (int v = 0; v < vectors; ++v) {
        const int i = LANES * v;
        float16 own_x = (float16)0.0f;
        float16 own_y = (float16)0.0f;
        float16 x0 = (float16)0.0f;
        float16 y0 = (float16)0.0f;
        float16 x1 = (float16)0.0f;
        float16 y1 = (float16)0.0f;
        float16 x2 = (float16)0.0f;
        float16 y2 = (float16)0.0f;
        float16 x3 = (float16)0.0f;
        float16 y3 = (float16)0.0f;
        for (int k = firsts[v]; k < firsts[v + 1]; ++k) {
            const int right = neighbours[3 * k];
            const int down = neighbours[3 * k + 1];
            const int s = i + down * pitch + right;
            const float16 qx = get(own + s);
            const float16 qy = get(own + area + s);
            const int16 given = ((int16)neighbours[3 * k + 2] & (int16)1 << LANE) != 0;
            const float16 share = given ? near(qx + right) * near(qy + down) : (float16)0.0f;
            __global const float *at = field + s;
            own_x += share * qx;
            own_y += share * qy;
            x0 += share * get(at);
            y0 += share * get(at + area);
            if (together > 1) {
                at += frame;
                x1 += share * get(at);
                y1 += share * get(at + area);
            }
            if (together > 2) {
                at += frame;
                x2 += share * get(at);
                y2 += share * get(at + area);
                at += frame;
                x3 += share * get(at);
                y3 += share * get(at + area);
            }
        }
        const float16 share = get(shares + i);
        put(residual + i, share * (x0 - own_x));
        put(residual + nodes + i, share * (y0 - own_y));
        if (together > 1) {
            put(residual + 2 * nodes + i, share * (x1 - own_x));
            put(residual + 3 * nodes + i, share * (y1 - own_y));
        }
        if (together > 2) {
            put(residual + 4 * nodes + i, share * (x2 - own_x));
            put(residual + 5 * nodes + i, share * (y2 - own_y));
            put(residual + 6 * nodes + i, share * (x3 - own_x));
            put(residual + 7 * nodes + i, share * (y3 - own_y));
        }
    }
    for (int f = 0; f < together; ++f) {
        __global float *x = residual + 2 * f * nodes;
        __global float *y = x + nodes;
        for (int row = rows[m]; row < rows[m + 1]; ++row) {
            float across = 0.0f;
            float along = 0.0f;
            for (int j = starts[row]; j < starts[row + 1]; ++j) {
                across += row_shares[j] * x[row_taps[j]];
                along += row_shares[j] * y[row_taps[j]];
            }
            x[targets[row]] = across;
            y[targets[row]] = along;
        }
    }
}
