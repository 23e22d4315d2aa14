"""Programs that show the worst case of a law for BSDFs; ``law`` puts before them what loads the plugin."""

DRAW = """ctx.mode = mi.TransportMode.Importance
n = 1_000_000
rng = mi.PCG32(n)
bs, weight = bsdf.sample(ctx, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))
delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
smooth = ~delta & (bsdf.pdf(ctx, si, bs.wo) > 0)
"""
CELL = f"""{DRAW}r0, r1, phi0, phi1, side = {{cell}}  # sqrt(1 - |cos|), azimuth from ... to; which hemisphere
r, phi = dr.sqrt((bs.wo.x**2 + bs.wo.y**2) / (1 + dr.abs(bs.wo.z))), dr.atan2(bs.wo.y, bs.wo.x)
inside = smooth & (r >= r0) & (r < r1) & (phi >= phi0) & (phi < phi1) & (bs.wo.z * side > 0)
r, phi = r0 + (r1 - r0) * rng.next_float32(), phi0 + (phi1 - phi0) * rng.next_float32()
sin = r * dr.sqrt(2 - r * r)
wo = mi.Vector3f(sin * dr.cos(phi), sin * dr.sin(phi), side * (1 - r * r))
density = dr.mean(bsdf.pdf(ctx, si, wo) * 2 * r)[0] * (r1 - r0) * (phi1 - phi0)
print("share of samples in the cell:", dr.count(inside)[0] / n, "pdf() says:", density)
"""
WHOLE = f"""{DRAW}wo = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
print("share of samples that pdf() describes:", dr.count(smooth)[0] / n)
print("integral of pdf() by uniform directions:", dr.mean(bsdf.pdf(ctx, si, wo))[0] * 4 * dr.pi)
print("albedo by samples:", dr.mean(weight, axis=1))
print("without lobes of one direction:", dr.mean(dr.select(delta, 0, weight), axis=1))
print("these by uniform directions:", dr.mean(bsdf.eval(ctx, si, wo), axis=1) * 4 * dr.pi)
for i in range(bsdf.component_count()):
    here = delta & (bs.sampled_component == i)
    stated = dr.sum(dr.select(here, bs.pdf, 0))[0] / max(dr.count(here)[0], 1)
    print("component", i, "states a probability of", stated, "and its share is", dr.count(here)[0] / n)
"""
SAMPLE = """pdf = bsdf.pdf(ctx, si, bs.wo)
print("a sample of", bs, "weight", weight)
print("there, pdf():", pdf, "eval() / pdf():", bsdf.eval(ctx, si, bs.wo) / pdf)
"""
VALUE = """print("eval():", bsdf.eval(ctx, si, wo), "pdf():", bsdf.pdf(ctx, si, wo))
print("eval_pdf():", bsdf.eval_pdf(ctx, si, wo))
print("a lane switched off:", bsdf.eval(ctx, si, wo, False))
print("the whole:", bsdf.eval(mi.BSDFContext(), si, wo), "flags:", hex(int(bsdf.flags())))
for ctx.component in range(bsdf.component_count()):
    flags = hex(int(bsdf.flags(ctx.component)))
    print("component", ctx.component, bsdf.eval(ctx, si, wo), "flags:", flags)
"""
