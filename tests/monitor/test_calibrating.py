from monitor.calibrating import FOUND, settings
from pipeline.frame_modes import Prior


def test_a_first_guess_is_believed_as_far_as_it_was_found_or_told():
    told = Prior(sigma_rad=0.2, sigma_m=0.7)
    assert settings(found=False, stored=told).prior is told
    assert settings(found=True, stored=told).prior is FOUND
    assert settings(found=True, stored=None).prior is FOUND
    drifted, default = settings(found=False, stored=None).prior, Prior()
    assert (drifted.sigma_rad, drifted.sigma_m) == (default.sigma_rad, default.sigma_m)
