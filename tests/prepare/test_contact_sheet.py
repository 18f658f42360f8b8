"""Contact sheets show what is dynamic."""

import numpy as np

from warpgs.prepare.contact_sheet import overlay_mask


def test_what_is_static_is_grey_and_what_is_dynamic_keeps_its_colours():
    image = np.full((20, 30, 3), (200, 40, 40), np.uint8)
    dynamic = np.zeros((20, 30), bool)
    dynamic[5:15, 5:20] = True
    painted = overlay_mask(image, dynamic)
    static = painted[~dynamic][np.any(painted[~dynamic] != (255, 230, 80), axis=-1)]
    assert np.ptp(static, axis=-1).max() == 0
    assert (painted[7:13, 7:18] == image[7:13, 7:18]).all()
    assert (painted[5, 5:20] == (255, 230, 80)).all()
