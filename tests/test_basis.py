import numpy as np

from mmmgpu.basis import cut, make_basis
from mmmgpu.regions import cover_mask, lip_mask, mouth_mask


def test_flows_fade_where_the_head_is_rigid(basis):
    rng = np.random.default_rng(0)
    flows = rng.normal(size=basis.flows.shape).astype(np.float32)
    made = make_basis(basis.images, flows, 2, basis.region)
    np.testing.assert_array_equal(made.flows[2], 0)
    others = [0, 1, 3]
    np.testing.assert_array_equal(
        made.flows[others][:, made.cover == 1], flows[others][:, made.cover == 1]
    )
    np.testing.assert_array_equal(made.flows[:, made.cover == 0], 0)
    assert (np.abs(made.flows) <= np.abs(flows)).all()
    assert made.flows.dtype == np.float32
    for mask, wanted in ((made.w_f, lip_mask), (made.w_t, mouth_mask), (made.cover, cover_mask)):
        np.testing.assert_array_equal(mask, wanted(basis.region))


def test_alpha_leaves_the_reference_out(basis):
    count = len(basis.images)
    assert basis.moving.tolist() == [i for i in range(count) if i != basis.reference]
    for k, i in enumerate(basis.moving):
        np.testing.assert_array_equal(basis.flow(np.eye(count - 1)[k]), basis.flows[i])
    alpha = np.random.default_rng(0).normal(size=count - 1)
    wanted = sum(a * basis.flows[i].astype(float) for a, i in zip(alpha, basis.moving, strict=True))
    np.testing.assert_allclose(basis.flow(alpha), wanted, atol=1e-4)


def test_a_cut_is_the_same_model_in_a_smaller_region(basis):
    part = cut(basis, (slice(8, 40), slice(5, 45)))
    x, y, _, _ = basis.region.box
    assert part.region.box == (x + 5, y + 8, 40, 32)
    assert part.region.mouth == basis.region.mouth
    assert part.reference == basis.reference
    inside = np.s_[8:40, 5:45]
    for name in ("w_f", "w_t", "cover"):
        np.testing.assert_array_equal(getattr(part, name), getattr(basis, name)[inside])
    np.testing.assert_array_equal(part.images, basis.images[:, 8:40, 5:45])
    np.testing.assert_array_equal(part.flows, basis.flows[:, 8:40, 5:45])
    assert part.images.flags.c_contiguous
    assert part.flows.flags.c_contiguous
