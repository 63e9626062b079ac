/* Vectors of 16 neighbours in a row of a plane, and what kernels do with them lane by lane.
 *
 * A plane is one channel of a picture in rows padded to whole vectors; a padded row is a pitch.
 * Operators and clang's own functions alone: PoCL calls its own of 16 lanes, and inlines none.
 */

#ifndef __has_builtin
#define __has_builtin(name) 0
#endif

#define FAR 1.0e8f /* [px] beyond any picture, inside int */
#define HUGE 1.0e30f
#define LANES 16
#define LANE ((int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))

/* Vectors anywhere in a plane. */
typedef float float4u __attribute__((ext_vector_type(4), aligned(4)));
typedef float float8u __attribute__((ext_vector_type(8), aligned(4)));
typedef float float16u __attribute__((ext_vector_type(16), aligned(4)));
typedef int int16u __attribute__((ext_vector_type(16), aligned(4)));

float16 get(__global const float *p)
{
    return *(__global const float16u *)p;
}

void put(__global float *p, const float16 v)
{
    *(__global float16u *)p = v;
}

void put_whole(__global int *p, const int16 n)
{
    *(__global int16u *)p = n;
}

int pitch_of(const int width)
{
    return (width + LANES - 1) / LANES * LANES;
}

float16 within_reach(const float16 q)
{
    const float16 low = q < -FAR ? (float16)(-FAR) : q;
    return low > FAR ? (float16)FAR : low;
}

/* floor(q). */
int16 whole(const float16 q)
{
    const int16 n = convert_int16(q);
    return n + (convert_float16(n) > q);
}

/* Where clang sees a comparison, to know whether any lane is set takes two instructions. */
int least(const int16 n)
{
#if __has_builtin(__builtin_reduce_min)
    return __builtin_reduce_min(n);
#else
    const int8 a = n.lo < n.hi ? n.lo : n.hi;
    const int4 b = a.lo < a.hi ? a.lo : a.hi;
    const int2 c = b.lo < b.hi ? b.lo : b.hi;
    return c.x < c.y ? c.x : c.y;
#endif
}

float least_value(const float16 n)
{
    const float8 a = n.lo < n.hi ? n.lo : n.hi;
    const float4 b = a.lo < a.hi ? a.lo : a.hi;
    const float2 c = b.lo < b.hi ? b.lo : b.hi;
    return c.x < c.y ? c.x : c.y;
}

/* One over the weight where it is enough, else 0. */
float16 share_of(const float16 n, const float enough)
{
    return n >= enough ? 1.0f / n : (float16)0.0f;
}

/* Sums of neighbours. */
float16 pairs(const float16 left, const float16 right)
{
    return (float16)(left.even + left.odd, right.even + right.odd);
}

float sum(const float16 v)
{
    const float8 a = v.lo + v.hi;
    const float4 b = a.lo + a.hi;
    return (b.s0 + b.s1) + (b.s2 + b.s3);
}
