/* Piecewise-affine warp: each pixel of a mesh is read where its triangle has gone.
 *
 * Places are double: rounded to float they would differ between runtimes by 1e-4 px.
 */

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

double place(
    __global const float *vertices,
    __global const int *triangles,
    __global const float *barycentric,
    const int base,
    const int triangle,
    const int pixel,
    const int axis,
    const int last)
{
    double at = 0.0;
    for (int corner = 0; corner < 3; ++corner) {
        const int vertex = base + triangles[3 * triangle + corner];
        const double share = barycentric[3 * pixel + corner];
        at += share * vertices[2 * vertex + axis];
    }
    return clamp(at, 0.0, (double)last);
}

__kernel void piecewise_warp(
    __global const float *field,        /* (fields, H, W, C), fields is 1 or the batch */
    __global const float *vertices,     /* (sets, N, 2) = (x, y) [px], sets is 1 or the batch */
    __global const int *triangles,      /* (K, 3), each below N */
    __global const int *index,          /* (P,), each below K */
    __global const float *barycentric,  /* (P, 3) */
    const int fields,
    const int sets,
    const int points,                   /* N */
    const int number,                   /* P */
    const int height,
    const int width,
    const int channels,
    const int first,
    const int count,
    /* outputs */
    __global float *warped)             /* (batch, P, C) */
{
    const int tid = get_global_id(0);
    if (tid >= count)
        return;
    const int i = first + tid;
    const int b = i / number;
    const int p = i % number;
    const int base = (b % sets) * points;
    const double x = place(vertices, triangles, barycentric, base, index[p], p, 0, width - 1);
    const double y = place(vertices, triangles, barycentric, base, index[p], p, 1, height - 1);
    const int x0 = (int)x;
    const int y0 = (int)y;
    const float fx = (float)(x - x0);
    const float fy = (float)(y - y0);
    const int x1 = min(x0 + 1, width - 1);
    const int y1 = min(y0 + 1, height - 1);
    const int near = ((b % fields) * height + y0) * width;
    const int far = ((b % fields) * height + y1) * width;
    for (int c = 0; c < channels; ++c) {
        float a0 = (1.0f - fx) * field[(near + x0) * channels + c];
        a0 += fx * field[(near + x1) * channels + c];
        float a1 = (1.0f - fx) * field[(far + x0) * channels + c];
        a1 += fx * field[(far + x1) * channels + c];
        warped[i * channels + c] = (1.0f - fy) * a0 + fy * a1;
    }
}
