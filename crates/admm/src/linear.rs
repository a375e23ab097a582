//! Linear systems of a few unknowns.

use ndarray::Array2;

/// The lower triangle L of `A = L Lᵀ`.
#[derive(Debug)]
pub(crate) struct Cholesky(Array2<f64>);

impl Cholesky {
    /// Of a matrix of which the lower triangle is read; nothing if it is not positive definite, but for rounding.
    pub(crate) fn of(mut a: Array2<f64>) -> Option<Self> {
        for i in 0..a.nrows() {
            for j in 0..=i {
                let known: f64 = (0..j).map(|k| a[[i, k]] * a[[j, k]]).sum();
                let left = a[[i, j]] - known;
                a[[i, j]] =
                    if i == j { Some(left).filter(|left| *left > 1e-9 * a[[i, i]])?.sqrt() } else { left / a[[j, j]] };
            }
        }
        Some(Self(a))
    }

    pub(crate) fn solve(&self, right: &[f64]) -> Vec<f64> {
        let (l, n) = (&self.0, right.len());
        let mut x = right.to_vec();
        for i in 0..n {
            let known: f64 = (0..i).map(|k| l[[i, k]] * x[k]).sum();
            x[i] = (x[i] - known) / l[[i, i]];
        }
        for i in (0..n).rev() {
            let known: f64 = (i + 1..n).map(|k| l[[k, i]] * x[k]).sum();
            x[i] = (x[i] - known) / l[[i, i]];
        }
        x
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn it_solves_what_has_a_solution() {
        let x = Cholesky::of(array![[4.0, 0.0], [2.0, 3.0]]).unwrap().solve(&[8.0, 8.0]);
        assert!((x[0] - 1.0).abs() < 1e-12 && (x[1] - 2.0).abs() < 1e-12, "{x:?}");
        assert!(Cholesky::of(array![[1.0, 0.0], [1.0, 1.0]]).is_none(), "equal rows");
    }
}
