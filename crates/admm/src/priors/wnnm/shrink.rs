//! Shrinks the singular values of many small matrices at once, one in each lane of a vector.

use multiversion::multiversion;

/// Matrices at once.
pub(super) const GROUPS: usize = 16;

/// A number of each of them.
type Lanes = [f32; GROUPS];

/// `c` of the weights.
const WEIGHT: f32 = 4.0 * std::f32::consts::SQRT_2;

/// Sweeps at most; six bring 36 columns to the precision of f32.
const SWEEPS: usize = 8;

/// Squared cosine between columns from which on they count as orthogonal.
const ORTHOGONAL: f32 = 1e-4;

/// Groups of patches, and the products of their pixels.
pub(super) struct Shrinker {
    /// Pixels of a patch, D.
    pixels: usize,
    sigma: f32,
    groups: Vec<Group>,
    /// `Y Yᵀ` of each, `[D][D]`, in units of σ².
    gram: Vec<Lanes>,
}

/// One group.
struct Group {
    count: usize,
    /// `count` rounded up to whole vectors.
    padded: usize,
    /// The mean patch.
    mean: Vec<f32>,
    /// What the patches have beyond the mean, in units of σ, `[D][padded]`, zeros at the end.
    rest: Vec<f32>,
}

impl Shrinker {
    pub(super) fn new(pixels: usize, sigma: f32) -> Self {
        Self { pixels, sigma, groups: Vec::with_capacity(GROUPS), gram: vec![[0.0; GROUPS]; pixels * pixels] }
    }

    /// The next group: `pixel(m, k)` is pixel `k` of patch `m`.
    pub(super) fn take(&mut self, count: usize, pixel: impl Fn(usize, usize) -> f32) {
        let padded = count.next_multiple_of(GROUPS);
        let mut rest = vec![0.0; self.pixels * padded];
        let mut mean = vec![0.0; self.pixels];
        for (k, (row, mean)) in rest.chunks_exact_mut(padded).zip(&mut mean).enumerate() {
            row[..count].iter_mut().enumerate().for_each(|(m, value)| *value = pixel(m, k));
            *mean = row[..count].iter().sum::<f32>() / count as f32;
            row[..count].iter_mut().for_each(|value| *value = (*value - *mean) / self.sigma);
        }
        gram_of(&rest, padded, self.groups.len(), &mut self.gram);
        self.groups.push(Group { count, padded, mean, rest });
    }

    /// The patches of all groups, one after another.
    pub(super) fn shrunk(mut self) -> Vec<f32> {
        let mut least = [f32::INFINITY; GROUPS];
        for (least, group) in least.iter_mut().zip(&self.groups) {
            *least = 4.0 * WEIGHT * (group.count as f32).sqrt();
        }
        let mut filter = vec![[0.0; GROUPS]; self.pixels * self.pixels];
        filters(&mut self.gram, self.pixels, &least, &mut filter);
        let total = self.groups.iter().map(|group| group.count).sum::<usize>();
        let mut all = Vec::with_capacity(total * self.pixels);
        let mut result = Vec::new();
        for (lane, group) in self.groups.iter().enumerate() {
            result.clear();
            result.resize(self.pixels * group.padded, 0.0);
            apply(&filter, lane, &group.rest, group.padded, &mut result);
            for m in 0..group.count {
                all.extend((0..self.pixels).map(|k| group.mean[k] + self.sigma * result[k * group.padded + m]));
            }
        }
        all
    }
}

/// `Y Yᵀ` of `rest` `[D][padded]` into a lane of `gram` `[D][D]`.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn gram_of(rest: &[f32], padded: usize, lane: usize, gram: &mut [Lanes]) {
    let pixels = rest.len() / padded;
    for (k, a) in rest.chunks_exact(padded).enumerate() {
        for (j, b) in rest.chunks_exact(padded).enumerate().take(k + 1) {
            let mut sums = [0.0; GROUPS];
            for (a, b) in a.as_chunks::<GROUPS>().0.iter().zip(b.as_chunks::<GROUPS>().0) {
                for l in 0..GROUPS {
                    sums[l] += a[l] * b[l];
                }
            }
            let sum = sums.iter().sum();
            (gram[k * pixels + j][lane], gram[j * pixels + k][lane]) = (sum, sum);
        }
    }
}

/// `filter = V diag(ŝ / s) Vᵀ` with `gram = V diag(s²) Vᵀ`, both `[D][D]`; s is shrunk to 0 where s² is not above `least`.
///
/// One-sided Jacobi rotations make the columns of `gram` orthogonal: they become s² V, the largest first. Eigenvectors that are shrunk
/// away need not be exact: once a sweep has gathered what is strong in the first columns, pairs of weak ones are left alone.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn filters(gram: &mut [Lanes], pixels: usize, least: &Lanes, filter: &mut [Lanes]) {
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
    filter.fill([0.0; GROUPS]);
    for column in gram.chunks_exact(pixels) {
        let norm = dot(column, column);
        let mut scale = [0f32; GROUPS];
        for l in 0..GROUPS {
            // The square of s⁴ is `norm`.
            let square = norm[l].sqrt();
            let kept = 0.5 + 0.5 * (1.0 - (least[l] / square).min(1.0)).sqrt();
            scale[l] = if square > least[l] { kept / norm[l] } else { 0.0 };
        }
        if scale == [0.0; GROUPS] {
            continue;
        }
        for (row, &a) in filter.chunks_exact_mut(pixels).zip(column) {
            for (w, b) in row.iter_mut().zip(column) {
                for l in 0..GROUPS {
                    w[l] += scale[l] * a[l] * b[l];
                }
            }
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

/// `result = filter · rest`, of one lane.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn apply(filter: &[Lanes], lane: usize, rest: &[f32], padded: usize, result: &mut [f32]) {
    let pixels = rest.len() / padded;
    for (filter, result) in filter.chunks_exact(pixels).zip(result.chunks_exact_mut(padded)) {
        for (w, row) in filter.iter().zip(rest.chunks_exact(padded)) {
            let w = w[lane];
            result.iter_mut().zip(row).for_each(|(r, x)| *r += w * x);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sci_forward::testing::gaussian;

    /// A matrix of known singular vectors: each singular value is shrunk by the formula, those of the weak one away.
    #[test]
    fn singular_values_are_shrunk_by_the_formula() {
        let (pixels, count, sigma) = (9, 20, 0.5f32);
        // Orthonormal: cosines, without the constant one among the patches, as their mean is taken off.
        let cosine = |k: usize, i: usize, n: usize| {
            let angle = std::f64::consts::PI * k as f64 * (i as f64 + 0.5) / n as f64;
            angle.cos() * (2.0 / n as f64).sqrt()
        };
        let singular = [40.0, 12.0, 0.9];
        let matrix = |values: [f64; 3], m: usize, k: usize| -> f64 {
            (0..3).map(|i| values[i] * cosine(i + 1, k, pixels) * cosine(i + 2, m, count)).sum()
        };
        let least = 4.0 * f64::from(WEIGHT) * (count as f64).sqrt() * f64::from(sigma).powi(2);
        let shrunk = singular.map(|s: f64| if s * s > least { (s + (s * s - least).sqrt()) / 2.0 } else { 0.0 });
        assert!(shrunk[1] > 0.0 && shrunk[2] == 0.0);
        let mut shrinker = Shrinker::new(pixels, sigma);
        for lane in 0..3 {
            shrinker.take(count, |m, k| matrix(singular, m, k) as f32 + lane as f32);
        }
        let found = shrinker.shrunk();
        assert_eq!(found.len(), 3 * count * pixels);
        for (i, &found) in found.iter().enumerate() {
            let (lane, m, k) = (i / (count * pixels), i / pixels % count, i % pixels);
            let expected = matrix(shrunk, m, k) + lane as f64;
            assert!((f64::from(found) - expected).abs() < 2e-4, "{lane} {m} {k}: {found} {expected}");
        }
    }

    /// Far below any noise the formula leaves a matrix as it is, although squares of squares of it in units of σ are huge.
    #[test]
    fn next_to_no_noise_changes_nothing() {
        let patches = gaussian((48, 36), 3);
        let mut shrinker = Shrinker::new(36, 0.001 / 255.0);
        shrinker.take(48, |m, k| patches[[m, k]]);
        let worst = shrinker.shrunk().iter().zip(&patches).fold(0f32, |worst, (v, x)| worst.max((v - x).abs()));
        assert!(worst < 1e-3, "{worst}");
    }

    #[test]
    fn noise_leaves_the_mean_patch() {
        let noise = gaussian((48, 36), 3);
        let mut shrinker = Shrinker::new(36, 1.0);
        shrinker.take(48, |m, k| noise[[m, k]]);
        let energy = shrinker.shrunk().iter().map(|v| v * v).sum::<f32>() / (48.0 * 36.0);
        assert!(energy < 0.1, "{energy}");
    }
}
