// States of the page that each show one thing, and the sentence that says which. tests/explore/test_browser.py compares the
// numbers of the sentences with the page's.

const FREE = { pixel: -1, mode: "nonparalyzable", start: "armed", period: 100, cycles: 2000, bins: 128, sigma: 2, dead: 75 };

export const PRESETS = [
  { name: "More light, worse depth", changes: { ...FREE, signal: 20, background: 0.1, delay: 60 },
    sentence: "With 20 photons a pulse the first of them always comes from the front of the pulse, and the detector is dead for the rest: the fullest bin is 3.4 ns early, half a metre. Move S down to 0.2 and it is where the light is." },
  { name: "The echo that is not there", changes: { ...FREE, signal: 8, background: 3, delay: 30, dead: 40, sigma: 1 },
    sentence: "Nearly every pulse is registered at 30 ns, so nearly every detector recovers 40 ns later: after the shadow, counts jump to 35 in the bin at 71 ns, where the end of the period has 20, and nothing is there." },
  { name: "Two surfaces become one", changes: { ...FREE, signal: 4, background: 0.1, delay: 40, second: 4, gap: 15, sigma: 1, log: 0 },
    sentence: "A pane and a wall 2.2 m behind it return 4 photons a pulse each, the two grey peaks; after the pane's photons the detector is dead, and of the wall's 8000 photons some 35 are registered." },
  { name: "A locked pixel counts like a clock", changes: { ...FREE, signal: 20, background: 0.1, delay: 60, dead: 175 },
    sentence: "A dead time of 175 ns ends between two bright pulses, so every second pulse is registered: 1000 counts of 2000 periods in every exposure. A Poisson count would scatter by 32." },
  { name: "Dim light, honest errors", changes: { ...FREE, signal: 0.03, background: 0.03, delay: 60, log: 0 },
    sentence: "60 signal photons in 2000 periods: maximum likelihood gives the depth with its standard error, 4 to 5 cm, as the scatter of Draw again shows; the fullest bin has no error to give." },
];
