//! Shrinks the singular values of many small matrices at once.
//!
//! What is kept of a group of patches is the part of it in the few eigenvectors of its Gram matrix whose eigenvalues are large. They are found in
//! a small subspace, by a few multiplications with the Gram matrix, and by Jacobi rotations in it; where the subspace is not large
//! enough, by rotations of the whole. All of that works on [`GROUPS`] groups, one in each lane of a vector.

use std::ops::Range;

use multiversion::multiversion;

/// Matrices at once.
pub(super) const GROUPS: usize = 16;

/// A number of each of them.
type Lanes = [f32; GROUPS];

/// Sweeps at most; six bring 36 columns to the precision of f32.
const SWEEPS: usize = 8;

/// Squared cosine between columns from which on they count as orthogonal.
const ORTHOGONAL: f32 = 1e-4;

/// Groups that are sorted by how much may be kept of them.
pub(super) const AT_ONCE: usize = 64;

/// Dimensions of the smallest subspace, and from one to the next.
const STEP: usize = 8;

/// Multiplications with the Gram matrix that turn the subspace.
const TURNS: usize = 1;

/// The share of the least eigenvalue that is kept up to which the smallest of a subspace shows that nothing large is outside.
const INSIDE: f32 = 0.5;

/// Patches that are put together from eigenvectors at a time.
const PATCHES: usize = 4;

/// Eigenvectors of a patch's vector of coefficients.
const VECTORS: usize = 8;

/// Works on [`AT_ONCE`] groups at a time; what it holds is memory only.
pub(super) struct Shrinker<'a> {
    /// Side of a patch.
    side: usize,
    /// Of a frame.
    width: usize,
    /// Pixels of a patch, D, rounded up to [`VECTORS`].
    pitch: usize,
    /// Where a subspace begins to turn: [`waves`].
    first: &'a [f32],
    groups: Vec<Group>,
    /// `Y Yᵀ` of each, `[D][D]`, in units of σ².
    gram: Vec<Lanes>,
    /// An orthonormal basis of a subspace, `[..][D]`, and its products with the Gram matrix.
    basis: Vec<Lanes>,
    products: Vec<Lanes>,
    /// `basis · gram · basisᵀ`.
    inside: Vec<Lanes>,
    /// Eigenvectors of which something is kept, `[..][D]`, and the factor of each.
    vectors: Vec<Lanes>,
    factors: Vec<Lanes>,
    /// Those of one group, `[D][..]` and `[..][D]`.
    own: Vec<f32>,
}

/// One group.
#[derive(Default)]
struct Group {
    /// The patches `[M][pitch]`.
    patches: Vec<f32>,
    /// The mean patch.
    mean: Vec<f32>,
    /// What the patches have beyond the mean, in units of σ, `[pitch / VECTORS][M][VECTORS]`: some pixels of all patches, then the next, and
    /// [`PATCHES`] vectors more.
    rest: Vec<f32>,
    /// Sum of its squares, no less than any eigenvalue.
    energy: f32,
    /// The least eigenvalue of which something is kept.
    least: f32,
    /// Where the result belongs.
    place: Range<usize>,
}

impl<'a> Shrinker<'a> {
    /// For patches of a side, in frames of a width, with the [`waves`] of such a patch.
    pub(super) fn new(side: usize, width: usize, first: &'a [f32]) -> Self {
        let pixels = side * side;
        Self {
            side,
            width,
            pitch: pixels.next_multiple_of(VECTORS),
            first,
            groups: (0..AT_ONCE).map(|_| Group::default()).collect(),
            gram: vec![[0.0; GROUPS]; pixels * pixels],
            basis: Vec::new(),
            products: Vec::new(),
            inside: Vec::new(),
            vectors: Vec::new(),
            factors: Vec::new(),
            own: Vec::new(),
        }
    }

    /// The patches of at most [`AT_ONCE`] groups of a plane, one after another, shrunk; `members` says where each begins.
    pub(super) fn shrink(&mut self, members: &[&[u32]], plane: &[f32], sigma: f32, weight: f32) -> Vec<f32> {
        let pixels = self.side * self.side;
        let mut end = 0;
        for (group, members) in self.groups.iter_mut().zip(members) {
            group.place = end..end + members.len() * pixels;
            end = group.place.end;
            group.least = 4.0 * weight * (members.len() as f32).sqrt();
            group.take(members, plane, self.side, self.width, 1.0 / sigma);
        }
        let mut all = Vec::with_capacity(end);
        for group in &self.groups[..members.len()] {
            group.place.clone().step_by(pixels).for_each(|_| all.extend_from_slice(&group.mean[..pixels]));
        }
        // Those that are alike are worked on together, and those of which nothing but the mean is kept not at all.
        let mut order: Vec<usize> = (0..members.len()).collect();
        let share = |&index: &usize| self.groups[index].energy / self.groups[index].least;
        order.retain(|index| share(index) > 1.0 || share(index).is_nan());
        order.sort_by(|a, b| share(a).total_cmp(&share(b)));
        let mut dimensions = STEP;
        for some in order.chunks(GROUPS) {
            dimensions = self.find_vectors(some, dimensions);
            for (lane, &index) in some.iter().enumerate() {
                self.put_together(lane, index, sigma, &mut all);
            }
        }
        all
    }

    /// Finds the eigenvectors of groups of which something is kept, and how much, in a subspace of so many dimensions, or of more if that is
    /// not enough; how many it took.
    fn find_vectors(&mut self, some: &[usize], mut dimensions: usize) -> usize {
        let pixels = self.side * self.side;
        let mut least = [f32::INFINITY; GROUPS];
        if some.len() < GROUPS {
            self.gram.fill([0.0; GROUPS]);
        }
        for (lane, &index) in some.iter().enumerate() {
            let group = &self.groups[index];
            gram_of(&group.rest[..group.patches.len()], self.pitch, lane, &mut self.gram);
            least[lane] = self.groups[index].least;
        }
        self.vectors.clear();
        self.factors.clear();
        while dimensions * 4 <= pixels * 3 {
            if self.subspace(dimensions, &least) {
                orthogonalise(&mut self.inside, dimensions, &least);
                for column in self.inside.chunks_exact(dimensions) {
                    let Some(factor) = kept(column, &least) else { continue };
                    self.factors.push(factor);
                    let from = self.vectors.len();
                    self.vectors.resize(from + pixels, [0.0; GROUPS]);
                    combine(&self.basis, column, &mut self.vectors[from..]);
                }
                return dimensions;
            }
            dimensions += STEP;
        }
        orthogonalise(&mut self.gram, pixels, &least);
        for column in self.gram.chunks_exact(pixels) {
            let Some(factor) = kept(column, &least) else { continue };
            self.factors.push(factor);
            self.vectors.extend_from_slice(column);
        }
        dimensions
    }

    /// Turns a subspace to the largest eigenvalues; whether those of which something is kept are surely all in it.
    fn subspace(&mut self, dimensions: usize, least: &Lanes) -> bool {
        let pixels = self.side * self.side;
        let first = &self.first[..dimensions * pixels];
        self.basis.clear();
        self.basis.extend(first.iter().map(|&first| [first; GROUPS]));
        self.products.resize(dimensions * pixels, [0.0; GROUPS]);
        self.inside.resize(dimensions * dimensions, [0.0; GROUPS]);
        for _ in 0..TURNS {
            multiply(&self.gram, &self.basis, &mut self.products);
            std::mem::swap(&mut self.basis, &mut self.products);
            // Once leaves of the weak ones too much of the strong.
            orthonormalise(&mut self.basis, pixels);
            orthonormalise(&mut self.basis, pixels);
        }
        multiply(&self.gram, &self.basis, &mut self.products);
        products(&self.basis, &self.products, pixels, &mut self.inside);
        let mut smallest = [f32::INFINITY; GROUPS];
        for own in self.inside.iter().step_by(dimensions + 1) {
            smallest.iter_mut().zip(own).for_each(|(smallest, own)| *smallest = smallest.min(*own));
        }
        smallest.iter().zip(least).all(|(smallest, least)| *smallest <= INSIDE * least)
    }

    /// Adds to the patches of a group what is kept: `σ Σ factor v vᵀ rest` over the vectors v.
    fn put_together(&mut self, lane: usize, index: usize, sigma: f32, all: &mut [f32]) {
        let (pixels, pitch) = (self.side * self.side, self.pitch);
        let group = &self.groups[index];
        let kept: Vec<usize> = (0..self.factors.len()).filter(|&k| self.factors[k][lane] > 0.0).collect();
        for some in kept.chunks(VECTORS) {
            // What is left of other groups meets nothing but zeros, or is not asked for.
            self.own.resize(2 * pitch * VECTORS, 0.0);
            let (of_pixels, of_vectors) = self.own.split_at_mut(pitch * VECTORS);
            of_pixels[pixels * VECTORS..].fill(0.0);
            for (k, &vector) in some.iter().enumerate() {
                let factor = sigma * self.factors[vector][lane];
                for (i, lanes) in self.vectors[vector * pixels..(vector + 1) * pixels].iter().enumerate() {
                    of_pixels[i * VECTORS + k] = lanes[lane];
                    of_vectors[k * pitch + i] = factor * lanes[lane];
                }
            }
            let of_vectors = &of_vectors[..some.len() * pitch];
            project(&group.rest, of_pixels, of_vectors, pixels, &mut all[group.place.clone()]);
        }
    }
}

impl Group {
    /// Takes the patches that begin at `members`.
    fn take(&mut self, members: &[u32], plane: &[f32], side: usize, width: usize, scale: f32) {
        let pitch = (side * side).next_multiple_of(VECTORS);
        self.patches.resize(members.len() * pitch, 0.0);
        for (patch, &member) in self.patches.chunks_exact_mut(pitch).zip(members) {
            copy(&plane[member as usize..], side, width, patch);
            patch[side * side..].fill(0.0);
        }
        self.mean.clear();
        self.mean.resize(pitch, 0.0);
        self.rest.resize(self.patches.len() + PATCHES * VECTORS, 0.0);
        self.energy = take_mean(&self.patches, &mut self.mean, scale, &mut self.rest);
    }
}

/// Writes to `rest` `[pitch / VECTORS][M][VECTORS]` what patches `[M][pitch]` have beyond their mean, scaled; the sum of its squares.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn take_mean(patches: &[f32], mean: &mut [f32], scale: f32, rest: &mut [f32]) -> f32 {
    let (pitch, count) = (mean.len(), patches.len() / mean.len());
    for patch in patches.chunks_exact(pitch) {
        mean.iter_mut().zip(patch).for_each(|(mean, value)| *mean += value);
    }
    let share = 1.0 / count as f32;
    mean.iter_mut().for_each(|mean| *mean *= share);
    let mut energy = [0f32; VECTORS];
    let rest = rest.as_chunks_mut::<VECTORS>().0;
    for (m, patch) in patches.chunks_exact(pitch).enumerate() {
        let pixels = patch.as_chunks::<VECTORS>().0.iter().zip(mean.as_chunks::<VECTORS>().0);
        for (block, (values, mean)) in pixels.enumerate() {
            let rest = &mut rest[block * count + m];
            for l in 0..VECTORS {
                rest[l] = (values[l] - mean[l]) * scale;
                energy[l] += rest[l] * rest[l];
            }
        }
    }
    energy.iter().sum()
}

/// Copies a patch from where it begins in a plane.
fn copy(from: &[f32], side: usize, width: usize, patch: &mut [f32]) {
    by_side!(side, |side| {
        for (i, row) in patch[..side * side].chunks_exact_mut(side).enumerate() {
            row.copy_from_slice(&from[i * width..][..side]);
        }
    });
}

/// Waves over a patch, `[D − 1][D]`, first those of low frequency, to which patches of pictures are nearest; each with a little of
/// all others, as no eigenvector must be orthogonal to all of them.
pub(super) fn waves(side: usize) -> Vec<f32> {
    let mut order: Vec<(usize, usize)> = (0..side).flat_map(|v| (0..side).map(move |u| (v, u))).skip(1).collect();
    order.sort_by_key(|&(v, u)| (v * v + u * u, v));
    let wave = |k: usize, i: usize| {
        let angle = std::f64::consts::PI * k as f64 * (i as f64 + 0.5) / side as f64;
        angle.cos() * (if k == 0 { 1.0f64 } else { 2.0 } / side as f64).sqrt()
    };
    let mut seed = 1u32;
    let mut noise = || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(seed >> 8) / f64::from(1 << 24) - 0.5
    };
    let of_wave = |&(v, u): &(usize, usize)| -> Vec<f32> {
        (0..side * side).map(|i| (wave(v, i / side) * wave(u, i % side) + 0.02 * noise()) as f32).collect()
    };
    order.iter().flat_map(of_wave).collect()
}

/// `Y Yᵀ` of `rest` `[pitch / VECTORS][M][VECTORS]` into a lane of `gram` `[D][D]`.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn gram_of(rest: &[f32], pitch: usize, lane: usize, gram: &mut [Lanes]) {
    let pixels = gram.len().isqrt();
    let some = VECTORS * (rest.len() / pitch);
    for (j, b) in rest.chunks_exact(some).enumerate() {
        for (i, a) in rest.chunks_exact(some).enumerate().take(j + 1) {
            let mut sums = [[0f32; VECTORS]; VECTORS];
            for (a, b) in a.as_chunks::<VECTORS>().0.iter().zip(b.as_chunks::<VECTORS>().0) {
                for k in 0..VECTORS {
                    for l in 0..VECTORS {
                        sums[k][l] += a[k] * b[l];
                    }
                }
            }
            for (i, sums) in (i * VECTORS..pixels).zip(&sums) {
                for (j, &sum) in (j * VECTORS..pixels).zip(sums) {
                    gram[i * pixels + j][lane] = sum;
                    gram[j * pixels + i][lane] = sum;
                }
            }
        }
    }
}

/// `products = basis · gram`, `[..][D]`.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn multiply(gram: &[Lanes], basis: &[Lanes], products: &mut [Lanes]) {
    const AT_ONCE: usize = 4;
    let pixels = gram.len().isqrt();
    let some = AT_ONCE * pixels;
    for (basis, products) in basis.chunks_exact(some).zip(products.chunks_exact_mut(some)) {
        for (i, row) in gram.chunks_exact(pixels).enumerate() {
            let mut sums = [[0f32; GROUPS]; AT_ONCE];
            for (j, g) in row.iter().enumerate() {
                for (k, sum) in sums.iter_mut().enumerate() {
                    let b = &basis[k * pixels + j];
                    for l in 0..GROUPS {
                        sum[l] += g[l] * b[l];
                    }
                }
            }
            for (k, sum) in sums.iter().enumerate() {
                products[k * pixels + i] = *sum;
            }
        }
    }
}

/// Makes the rows of a basis orthonormal, one after another; what depends on those before becomes 0.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn orthonormalise(basis: &mut [Lanes], pixels: usize) {
    for q in 0..basis.len() / pixels {
        let (before, from_q) = basis.split_at_mut(q * pixels);
        let own = &mut from_q[..pixels];
        let whole = dot(own, own);
        for other in before.chunks_exact(pixels) {
            let c = dot(other, own);
            for (own, other) in own.iter_mut().zip(other) {
                for l in 0..GROUPS {
                    own[l] -= c[l] * other[l];
                }
            }
        }
        let left = dot(own, own);
        let mut scale = [0f32; GROUPS];
        for l in 0..GROUPS {
            scale[l] = if left[l] > 1e-10 * whole[l] { 1.0 / left[l].sqrt() } else { 0.0 };
        }
        for own in own.iter_mut() {
            for l in 0..GROUPS {
                own[l] *= scale[l];
            }
        }
    }
}

/// `vector = Σ_k column[k] basis[k]`.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn combine(basis: &[Lanes], column: &[Lanes], vector: &mut [Lanes]) {
    for (c, basis) in column.iter().zip(basis.chunks_exact(vector.len())) {
        for (v, b) in vector.iter_mut().zip(basis) {
            for l in 0..GROUPS {
                v[l] += c[l] * b[l];
            }
        }
    }
}

/// The products `inside[i][j]` of the rows of two matrices `[..][D]`, of which it is known that they are symmetric.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn products(rows: &[Lanes], others: &[Lanes], pixels: usize, inside: &mut [Lanes]) {
    let dimensions = rows.len() / pixels;
    for (i, a) in rows.chunks_exact(pixels).enumerate() {
        for (j, b) in others.chunks_exact(pixels).enumerate().skip(i) {
            let product = dot(a, b);
            (inside[i * dimensions + j], inside[j * dimensions + i]) = (product, product);
        }
    }
}

/// By how much `v vᵀ` is to be multiplied to shrink the eigenvalue of a column v = s² · eigenvector, in lanes where s² is above `least`, and 0
/// where it is not; nothing if it is in none.
fn kept(column: &[Lanes], least: &Lanes) -> Option<Lanes> {
    let norm = dot(column, column);
    let mut factor = [0f32; GROUPS];
    for l in 0..GROUPS {
        // The square of s⁴ is `norm`.
        let square = norm[l].sqrt();
        if square > least[l] {
            factor[l] = (0.5 + 0.5 * (1.0 - least[l] / square).sqrt()) / norm[l];
        }
    }
    factor.iter().any(|&factor| factor > 0.0).then_some(factor)
}

/// Adds to patches `[M][D]` what is in some vectors: `of_vectorsᵀ · of_pixelsᵀ · rest`; `rest` is `[pitch / VECTORS][M][VECTORS]`, `of_pixels`
/// `[pitch][VECTORS]`, `of_vectors` `[..][pitch]`.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn project(rest: &[f32], of_pixels: &[f32], of_vectors: &[f32], pixels: usize, patches: &mut [f32]) {
    let (pitch, count) = (of_pixels.len() / VECTORS, patches.len() / pixels);
    let (rest, of_pixels) = (rest.as_chunks::<VECTORS>().0, of_pixels.as_chunks::<VECTORS>().0);
    for (first, patches) in (0..count).step_by(PATCHES).zip(patches.chunks_mut(PATCHES * pixels)) {
        let mut coefficients = [[0f32; VECTORS]; PATCHES];
        for (block, vectors) in of_pixels.chunks_exact(VECTORS).enumerate() {
            // The last patches take some of the next block along, which nobody asks for.
            let values = &rest[block * count + first..][..PATCHES];
            for (k, vectors) in vectors.iter().enumerate() {
                for m in 0..PATCHES {
                    let value = values[m][k];
                    for l in 0..VECTORS {
                        coefficients[m][l] += value * vectors[l];
                    }
                }
            }
        }
        for (patch, coefficients) in patches.chunks_exact_mut(pixels).zip(&coefficients) {
            for (vector, c) in of_vectors.chunks_exact(pitch).zip(coefficients) {
                patch.iter_mut().zip(vector).for_each(|(p, v)| *p += c * v);
            }
        }
    }
}

/// Turns the columns of a symmetric matrix `V diag(s²) Vᵀ` into s² V, by one-sided Jacobi rotations, the largest first, where s² is above
/// `least`.
///
/// Eigenvectors that are shrunk away need not be exact: once a sweep has gathered what is strong in the first columns, pairs of weak ones
/// are left alone.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn orthogonalise(gram: &mut [Lanes], pixels: usize, least: &Lanes) {
    let mut weak = [0f32; GROUPS];
    for (weak, least) in weak.iter_mut().zip(least) {
        *weak = 0.25 * least * least;
    }
    let mut norms = vec![[0.0; GROUPS]; pixels];
    for sweep in 0..SWEEPS {
        for (column, norm) in gram.chunks_exact(pixels).zip(&mut norms) {
            *norm = dot(column, column);
        }
        let mut worst = [0f32; GROUPS];
        for q in 1..pixels {
            let (before, from_q) = gram.split_at_mut(q * pixels);
            let (norms_before, norms_from_q) = norms.split_at_mut(q);
            let columns = before.chunks_exact_mut(pixels).zip(norms_before);
            for (p, a) in columns {
                let b = &mut norms_from_q[0];
                if sweep == 0 || any_above(a, b, &weak) {
                    rotate((p, a), (&mut from_q[..pixels], b), &weak, &mut worst);
                }
            }
        }
        if worst.iter().all(|&w| w <= ORTHOGONAL) {
            break;
        }
    }
}

#[inline(always)]
fn dot(a: &[Lanes], b: &[Lanes]) -> Lanes {
    let mut sums = [0.0; GROUPS];
    for (a, b) in a.iter().zip(b) {
        for l in 0..GROUPS {
            sums[l] += a[l] * b[l];
        }
    }
    sums
}

/// Whether a squared norm in one of two columns is not weak.
#[inline(always)]
fn any_above(a: &Lanes, b: &Lanes, weak: &Lanes) -> bool {
    let mut above = false;
    for l in 0..GROUPS {
        above |= a[l].max(b[l]) > weak[l];
    }
    above
}

/// Makes two columns, each with its squared norm, orthogonal, and the first the larger; `worst` is the greatest squared cosine that was
/// between columns of which one is not weak.
#[inline(always)]
fn rotate((p, a): (&mut [Lanes], &mut Lanes), (q, b): (&mut [Lanes], &mut Lanes), weak: &Lanes, worst: &mut Lanes) {
    let c = dot(p, q);
    // The new columns are x p + y q and z p + w q.
    let [mut x, mut y, mut z, mut w] = [[0f32; GROUPS]; 4];
    for l in 0..GROUPS {
        // A quotient at a time: with a σ close to 0 the product of both norms would leave the range of numbers.
        let cosine = (c[l] / a[l].max(f32::MIN_POSITIVE)) * (c[l] / b[l].max(f32::MIN_POSITIVE));
        let turns = cosine > 1e-12;
        let zeta = (b[l] - a[l]) / (2.0 * if turns { c[l] } else { 1.0 });
        let t = 1f32.copysign(zeta) / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
        let t = if turns { t } else { 0.0 };
        let cos = 1.0 / (1.0 + t * t).sqrt();
        let sin = cos * t;
        let matters = a[l].max(b[l]) > weak[l];
        worst[l] = worst[l].max(if matters { cosine } else { 0.0 });
        let (of_p, of_q) = ((a[l] - t * c[l]).max(0.0), b[l] + t * c[l]);
        let swaps = of_q > of_p;
        (a[l], b[l]) = (of_p.max(of_q), of_p.min(of_q));
        x[l] = if swaps { sin } else { cos };
        y[l] = if swaps { cos } else { -sin };
        z[l] = if swaps { cos } else { sin };
        w[l] = if swaps { -sin } else { cos };
    }
    for (p, q) in p.iter_mut().zip(q) {
        for l in 0..GROUPS {
            let (of_p, of_q) = (p[l], q[l]);
            p[l] = x[l] * of_p + y[l] * of_q;
            q[l] = z[l] * of_p + w[l] * of_q;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::WnnmParams;
    use ndarray::Array2;
    use sci_forward::testing::gaussian;

    /// Groups of as many patches `[M][D]` each, one after another, shrunk with the usual weight.
    fn shrunk(side: usize, count: usize, patches: &[f32], sigma: f32) -> Vec<f32> {
        let pixels = side * side;
        let begins: Vec<u32> = (0..patches.len() / pixels).map(|m| (m * pixels) as u32).collect();
        let members: Vec<&[u32]> = begins.chunks(count).collect();
        // A frame as wide as a patch has the pixels of each patch together.
        Shrinker::new(side, side, &waves(side)).shrink(&members, patches, sigma, WnnmParams::default().weight)
    }

    /// s² of which nothing is kept.
    fn least(count: usize, sigma: f64) -> f64 {
        4.0 * f64::from(WnnmParams::default().weight) * (count as f64).sqrt() * sigma.powi(2)
    }

    /// A matrix of known singular vectors: each singular value is shrunk by the formula, those of the weak one away; in a subspace and without.
    #[test]
    fn singular_values_are_shrunk_by_the_formula() {
        for (side, count, sigma, tolerance) in [(3, 20, 0.5f32, 3e-4), (6, 20, 0.5, 1e-3), (9, 30, 0.5, 1e-3)] {
            let pixels = side * side;
            // Orthonormal: cosines, without the constant one among the patches, as their mean is taken off.
            let cosine = |k: usize, i: usize, n: usize| {
                let angle = std::f64::consts::PI * k as f64 * (i as f64 + 0.5) / n as f64;
                angle.cos() * (2.0 / n as f64).sqrt()
            };
            let singular = [40.0, 12.0, 0.9];
            let matrix = |values: [f64; 3], m: usize, k: usize| -> f64 {
                (0..3).map(|i| values[i] * cosine(i + 1, k, pixels) * cosine(i + 2, m, count)).sum()
            };
            let least = least(count, sigma.into());
            let shrink = |s: f64| if s * s > least { (s + (s * s - least).sqrt()) / 2.0 } else { 0.0 };
            let shrunk_values = singular.map(shrink);
            assert!(shrunk_values[1] > 0.0 && shrunk_values[2] == 0.0);
            let of = |values: [f64; 3]| -> Vec<f32> {
                let all = (0..3 * count).flat_map(|m| (0..pixels).map(move |k| (m / count, m % count, k)));
                all.map(|(group, m, k)| (matrix(values, m, k) + group as f64) as f32).collect()
            };
            for (found, expected) in shrunk(side, count, &of(singular), sigma).iter().zip(of(shrunk_values)) {
                assert!((found - expected).abs() < tolerance, "{side}: {found} {expected}");
            }
        }
    }

    /// By the definition in f64: all eigenvectors of the Gram matrix by two-sided rotations.
    fn naive(patches: &[f32], pixels: usize, sigma: f64) -> Vec<f64> {
        let count = patches.len() / pixels;
        let mean = |k: usize| (0..count).map(|m| f64::from(patches[m * pixels + k])).sum::<f64>() / count as f64;
        let means: Vec<f64> = (0..pixels).map(mean).collect();
        let rest = Array2::from_shape_fn((count, pixels), |(m, k)| f64::from(patches[m * pixels + k]) - means[k]);
        let (mut gram, mut vectors) = (rest.t().dot(&rest), Array2::<f64>::eye(pixels));
        for _ in 0..30 {
            for q in 1..pixels {
                for p in 0..q {
                    let angle = 0.5 * (2.0 * gram[[p, q]]).atan2(gram[[q, q]] - gram[[p, p]]);
                    let mut turn = Array2::eye(pixels);
                    (turn[[p, p]], turn[[q, q]]) = (angle.cos(), angle.cos());
                    (turn[[p, q]], turn[[q, p]]) = (angle.sin(), -angle.sin());
                    let turn: Array2<f64> = turn;
                    gram = turn.t().dot(&gram).dot(&turn);
                    vectors = vectors.dot(&turn);
                }
            }
        }
        let least = least(count, sigma);
        let kept = |s2: f64| if s2 > least { 0.5 + 0.5 * (1.0 - least / s2).sqrt() } else { 0.0 };
        let factors = Array2::from_diag(&gram.diag().mapv(kept));
        let filtered = rest.dot(&vectors).dot(&factors).dot(&vectors.t());
        filtered.indexed_iter().map(|((_, k), value)| value + means[k]).collect()
    }

    /// Groups with few and with many strong components together: each gets the subspace that it needs.
    #[test]
    fn a_subspace_finds_what_the_definition_does() {
        let (side, count, pixels) = (4, 30, 16);
        let mut patches = Vec::new();
        for rank in [0, 1, 3, 7, 16] {
            let (left, right) = (gaussian((count, rank.max(1)), 3), gaussian((rank.max(1), pixels), 4));
            let signal = left.dot(&right) * if rank == 0 { 0.0 } else { 1.0 };
            patches.extend((signal + gaussian((count, pixels), 5) * 0.05).iter());
        }
        let found = shrunk(side, count, &patches, 0.1);
        for (found, patches) in found.chunks(count * pixels).zip(patches.chunks(count * pixels)) {
            let expected = naive(patches, pixels, 0.1);
            let energy = patches.iter().map(|v| f64::from(v * v)).sum::<f64>();
            let off: f64 = found.iter().zip(expected).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum();
            assert!(off < 1e-5 * energy, "{off} of {energy}");
        }
    }

    /// Far below any noise the formula leaves a matrix as it is, although squares of squares of it in units of σ are huge.
    #[test]
    fn next_to_no_noise_changes_nothing() {
        let patches = gaussian((48, 36), 3);
        let found = shrunk(6, 48, patches.as_slice().unwrap(), 0.001 / 255.0);
        let worst = found.iter().zip(&patches).fold(0f32, |worst, (v, x)| worst.max((v - x).abs()));
        assert!(worst < 1e-3, "{worst}");
    }

    #[test]
    fn noise_leaves_the_mean_patch() {
        let noise = gaussian((48, 36), 3);
        let found = shrunk(6, 48, noise.as_slice().unwrap(), 1.0);
        let energy = found.iter().map(|v| v * v).sum::<f32>() / (48.0 * 36.0);
        assert!(energy < 0.1, "{energy}");
    }
}
