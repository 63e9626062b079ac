/* A map made of Gaussians and an affine part (CE05, Eq. 6): 16 points a work-item.
 *
 * Eight at a time. Gaussians in float, sums in double. Lanes beyond the points do the last point
 * again, and are not written. PoCL 3.0 calls its own exp, min and conversions as functions, and
 * aborts the process on a conversion of 8 doubles to float.
 */

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#define LANES 16
#define WIDE 8
#define FAR 3.0e38f   /* squares beyond float stay finite: 0 times them is 0 */
#define LEAST -126.0f /* 2 to it is nothing, but no denormal number */
#define ROUND 12582912.0f /* 1.5 2^23: added to a number, it leaves the nearest whole one */
#define LOG2_E 1.44269504f

/* 2^x for x <= 0, within 2e-7 of it: 2^n 2^r, |r| <= 1/2, the best polynomial with 2^0 = 1. */
float8 decay(const float8 x)
{
    const float8 within = x > LEAST ? x : LEAST;
    const float8 shifted = within + ROUND;
    const float8 r = within - (shifted - ROUND);
    float8 p = 1.3264726e-3f * r + 9.6715130e-3f;
    p = p * r + 5.5507336e-2f;
    p = p * r + 2.4022242e-1f;
    p = p * r + 6.9314700e-1f;
    p = p * r + 1.0f;
    return as_float8(as_int8(p) + (as_int8(shifted) << 23)); /* what ROUND adds is shifted out */
}

double4 wide(const float4 x)
{
    return (double4)(x.s0, x.s1, x.s2, x.s3);
}

__kernel void evaluate_rbf(
    __global const float *points,   /* (P, 2) = (x, y) [px] */
    __global const float *centres,  /* (N, 2) [px] */
    __global const float *weights,  /* (N, 2) [px] */
    __global const float *affine,   /* (2, 3), columns for 1, x and y */
    const int number,               /* P */
    const int terms,                /* N */
    const float sharpness,          /* [1/px^2] */
    const int first,
    const int count,
    /* outputs */
    __global float *mapped)         /* (P, 2) [px] */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    for (int part = 0; part < LANES / WIDE; ++part) {
        const int start = (first + tid) * LANES + part * WIDE;
        float px[WIDE], py[WIDE];
        for (int lane = 0; lane < WIDE; ++lane) {
            const int p = start + lane < number ? start + lane : number - 1;
            px[lane] = points[2 * p];
            py[lane] = points[2 * p + 1];
        }
        const float8 x = (float8)(px[0], px[1], px[2], px[3], px[4], px[5], px[6], px[7]);
        const float8 y = (float8)(py[0], py[1], py[2], py[3], py[4], py[5], py[6], py[7]);
        double4 u[2], v[2];
        for (int side = 0; side < 2; ++side) {
            const double4 wx = wide(side ? x.hi : x.lo);
            const double4 wy = wide(side ? y.hi : y.lo);
            u[side] = (double)affine[0] + (double)affine[1] * wx + (double)affine[2] * wy;
            v[side] = (double)affine[3] + (double)affine[4] * wx + (double)affine[5] * wy;
        }
        const float falling = -LOG2_E * sharpness;
        for (int k = 0; k < terms; ++k) {
            const float8 dx = x - centres[2 * k];
            const float8 dy = y - centres[2 * k + 1];
            const float8 square = dx * dx + dy * dy;
            const float8 phi = decay(falling * (square < FAR ? square : FAR));
            u[0] += (double)weights[2 * k] * wide(phi.lo);
            u[1] += (double)weights[2 * k] * wide(phi.hi);
            v[0] += (double)weights[2 * k + 1] * wide(phi.lo);
            v[1] += (double)weights[2 * k + 1] * wide(phi.hi);
        }
        const double mu[WIDE] = {u[0].s0, u[0].s1, u[0].s2, u[0].s3,
                                 u[1].s0, u[1].s1, u[1].s2, u[1].s3};
        const double mv[WIDE] = {v[0].s0, v[0].s1, v[0].s2, v[0].s3,
                                 v[1].s0, v[1].s1, v[1].s2, v[1].s3};
        for (int lane = 0; lane < WIDE && start + lane < number; ++lane) {
            mapped[2 * (start + lane)] = (float)mu[lane];
            mapped[2 * (start + lane) + 1] = (float)mv[lane];
        }
    }
}
