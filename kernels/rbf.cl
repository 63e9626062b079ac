/* A map made of Gaussians and an affine part (CE05, Eq. 6): 16 points a work-item.
 *
 * Four at a time: PoCL 3.0 aborts the process on a conversion of 8 doubles to float. Gaussians in
 * float, sums in double. Lanes beyond the points do the last point again, and are not written.
 */

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#define LANES 16
#define WIDE 4
#define FAR 3.0e38f /* squares beyond float stay finite: 0 times them is 0 */

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
            const int p = min(start + lane, number - 1);
            px[lane] = points[2 * p];
            py[lane] = points[2 * p + 1];
        }
        const float4 x = vload4(0, px);
        const float4 y = vload4(0, py);
        const double4 wx = convert_double4(x);
        const double4 wy = convert_double4(y);
        double4 u = (double)affine[0] + (double)affine[1] * wx + (double)affine[2] * wy;
        double4 v = (double)affine[3] + (double)affine[4] * wx + (double)affine[5] * wy;
        for (int k = 0; k < terms; ++k) {
            const float4 dx = x - centres[2 * k];
            const float4 dy = y - centres[2 * k + 1];
            const float4 phi = exp(-sharpness * fmin(dx * dx + dy * dy, FAR));
            const double4 wide = convert_double4(phi);
            u += (double)weights[2 * k] * wide;
            v += (double)weights[2 * k + 1] * wide;
        }
        float pu[WIDE], pv[WIDE];
        vstore4(convert_float4(u), 0, pu);
        vstore4(convert_float4(v), 0, pv);
        for (int lane = 0; lane < min(WIDE, number - start); ++lane) {
            mapped[2 * (start + lane)] = pu[lane];
            mapped[2 * (start + lane) + 1] = pv[lane];
        }
    }
}
