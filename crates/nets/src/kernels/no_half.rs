//! What stands for `half` where there is no matrix unit: nothing makes images of its form, so nothing calls this.

use super::blocked::Blocked;

const REASON: &str = "halved images are for the matrix unit";

pub(super) unsafe fn round(_: &Blocked, _: &mut Blocked) {
    unreachable!("{REASON}")
}

pub(super) unsafe fn mask(_: &mut Blocked, _: &Blocked) {
    unreachable!("{REASON}")
}

pub(super) unsafe fn add(_: &mut Blocked, _: &Blocked) {
    unreachable!("{REASON}")
}

pub(super) fn widen_stride(_: &Blocked, _: &mut Blocked) {
    unreachable!("{REASON}")
}
