"""Models of the literature as files of XPPAUT, each with its equations written by hand in Python.

`rates(t, y, p)` takes the parameters of the file by name, and gives the rates (of a map: the next values).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import cos, cosh, exp, floor, log, pi, sin, tanh

Rates = Callable[[float, Sequence[float], dict[str, float]], Sequence[float]]


@dataclass(frozen=True)
class Published:
    """A model's file and its equations."""

    text: str
    parameters: dict[str, float]
    start: tuple[float, ...]
    rates: Rates
    time: float = 10.0
    omega: float | None = None


def _morris_lecar(t, y, p):
    v, w = y
    m = 0.5 * (1 + tanh((v - p["v1"]) / p["v2"]))
    n = 0.5 * (1 + tanh((v - p["v3"]) / p["v4"]))
    return (
        p["iapp"] + p["gl"] * (p["vl"] - v) + p["gk"] * w * (p["vk"] - v) - p["gca"] * m * (v - 1.0),
        p["phi"] * cosh((v - p["v3"]) / (2 * p["v4"])) * (n - w),
    )


def _hodgkin_huxley(t, y, p):
    v, m, h, n = y
    am, bm = 0.1 * (v + 40) / (1 - exp(-(v + 40) / 10)), 4 * exp(-(v + 65) / 18)
    ah, bh = 0.07 * exp(-(v + 65) / 20), 1 / (1 + exp(-(v + 35) / 10))
    an, bn = 0.01 * (v + 55) / (1 - exp(-(v + 55) / 10)), 0.125 * exp(-(v + 65) / 80)
    ionic = p["gna"] * h * (v - p["vna"]) * m**3 + p["gk"] * (v - p["vk"]) * n**4 + p["gl"] * (v - p["vl"])
    return ((p["I"] - ionic) / p["C"], am * (1 - m) - bm * m, ah * (1 - h) - bh * h, an * (1 - n) - bn * n)


def _wilson_cowan(t, y, p):
    def f(u):
        return 1 / (1 + exp(-u))

    u, v = y
    return (
        -u + f(p["aee"] * u - p["aie"] * v - p["ze"] + p["i0"] * sin(p["w"] * t)),
        (-v + f(p["aei"] * u - p["aii"] * v - p["zi"])) / p["tau"],
    )


def _ring(t, y, p):
    n = len(y)
    return [p["om"] + p["k"] * (sin(y[(i + 1) % n] - y[i]) + sin(y[i - 1] - y[i])) for i in range(n)]


def _bump(t, y, p):
    return [
        -u + tanh(p["a"] * sum(cos(2 * pi * (i - k) / 8) * y[k] for k in range(8))) + (0.1 if i == 3 else 0.0)
        for i, u in enumerate(y)
    ]


def _duffing(t, y, p):
    x, v = y
    return v, -p["d"] * v + x - x**3 + p["A"] * cos(p["omega"] * t)


def _two_tones(t, y, p):
    x, v = y
    return v, -0.3 * v - x + p["a"] * sin(2 * pi * t / p["per"]) + p["b"] * cos(6 * pi * t / p["per"] + 1)


def _switched(t, y, p):
    x, v = y
    push = p["a"] if v > p["v0"] else -p["a"] / 2
    return v, -x - 0.4 * v + push * (1.0 if x >= 0 else 0.0) + max(x, v) / 10 - min(x, 0.5) + abs(v) * 0.01


def _impulse(t, y, p):
    (v,) = y
    return [-v + p["s"] * (t / p["tdone"] if t < p["tdone"] else 0.0)]


PUBLISHED = {
    "morris_lecar": Published(
        """# C. Morris and H. Lecar, Biophys. J. 35 (1981) 193
par iapp=0.12 phi=.333
par v1=-.01,v2=0.15,v3=0.1,v4=0.145,gca=1.33
par vk=-.7,vl=-.5,gk=2.0,gl=.5
# the open fractions
minf(v)=.5*(1+tanh((v-v1)/v2))
ninf(V)=.5*(1+tanh((v-v3)/v4))
lamn(v)= phi*cosh((v-v3)/(2*v4))
ica=gca*minf(v)*(v-1)
V'=iapp+gl*(vl-v)+gk*w*(vk-v)-ica
dw/dt=lamn(v)*(ninf(v)-w)
init v=-.2,w=.1
aux I_Ca=ica
@ total=30,dt=.05,xlo=-.6,xhi=1.2
@ parmin=-.5,parmax=.5
set strong {iapp=.2, gk=3, xlo=0}
done
everything here is ignored'
""",
        dict(iapp=0.12, phi=0.333, v1=-0.01, v2=0.15, v3=0.1, v4=0.145, gca=1.33, vk=-0.7, vl=-0.5, gk=2.0, gl=0.5),
        (-0.2, 0.1),
        _morris_lecar,
        30.0,
    ),
    "hodgkin_huxley": Published(
        """# A. L. Hodgkin and A. F. Huxley, J. Physiol. 117 (1952) 500, shifted
params I=10,vna=50,vk=-77,vl=-54.4
params gna=120,gk=36,gl=0.3,C=1
am(v)=.1*(v+40)/(1-exp(-(v+40)/10))
bm(v)=4*exp(-(v+65)/18)
ah(v)=.07*exp(-(v+65)/20)
bh(v)=1/(1+exp(-(v+35)/10))
an(v)=.01*(v+55)/(1-exp(-(v+55)/10))
bn(v)=.125*exp(-(v+65)/80)
v'=(I - gna*h*(v-vna)*m^3-gk*(v-vk)*n^4-gl*(v-vl))/c
m'=am(v)*(1-m)-bm(v)*m
h'=ah(v)*(1-h)-bh(v)*h
n'=an(v)*(1-n)-bn(v)*n
v(0)=-60
m(0)=.1
h(0)=.5
n(0)=.3
done
""",
        dict(I=10.0, vna=50.0, vk=-77.0, vl=-54.4, gna=120.0, gk=36.0, gl=0.3, C=1.0),
        (-60.0, 0.1, 0.5, 0.3),
        _hodgkin_huxley,
        10.0,
    ),
    "fitzhugh_nagumo": Published(
        "par a=.7,b=.8,tau=12.5,I=.5\nv'=v-v^3/3-w+I\nw'=(v+a-b*w)/tau\ninit v=1\n",
        dict(a=0.7, b=0.8, tau=12.5, I=0.5),
        (1.0, 0.0),
        lambda t, y, p: (y[0] - y[0] ** 3 / 3 - y[1] + p["I"], (y[0] + p["a"] - p["b"] * y[1]) / p["tau"]),
    ),
    "lorenz": Published(
        "p s=10 r=27\nnumber b=2.66666\ninit x=-7.5  y=-3.6  z=30\nx'=s*(-x+y)\ny'=r*x-y-x*z\nz'=-b*z+x*y\nd\n",
        dict(s=10.0, r=27.0),
        (-7.5, -3.6, 30.0),
        lambda t, y, p: (p["s"] * (y[1] - y[0]), p["r"] * y[0] - y[1] - y[0] * y[2], -2.66666 * y[2] + y[0] * y[1]),
        2.0,
    ),
    "rossler": Published(
        "par a=.2,b=.2,c=5.7\ndx/dt = -y-z\ndy/dt = x+a*y\ndz/dt = b+z*(x-c)\ninit x=1\n",
        dict(a=0.2, b=0.2, c=5.7),
        (1.0, 0.0, 0.0),
        lambda t, y, p: (-y[1] - y[2], y[0] + p["a"] * y[1], p["b"] + y[2] * (y[0] - p["c"])),
    ),
    "brusselator": Published(
        "par a=1,b=3\n!c=b+1\nu'=a-c*u+v*u^2\nv'=b*u-v*u^2\ninit u=1,v=1\n",
        dict(a=1.0, b=3.0),
        (1.0, 1.0),
        lambda t, y, p: (p["a"] - (p["b"] + 1) * y[0] + y[1] * y[0] ** 2, p["b"] * y[0] - y[1] * y[0] ** 2),
    ),
    "van_der_pol": Published(
        "p mu=1.5\nx'=y\ny'=mu*(1-x**2)*y-x\ninit x=.1\nb x-x'\nb y-y'\n",
        dict(mu=1.5),
        (0.1, 0.0),
        lambda t, y, p: (y[1], p["mu"] * (1 - y[0] ** 2) * y[1] - y[0]),
    ),
    "signs": Published(  # -x^2 is -(x^2), a/b*c is (a/b)*c, a^b^c is (a^b)^c, and comparisons bind as powers do
        "par a=2,b=3\nx'=-x^2-a/b*x+a^.5^b-(-x)+2*(x>.1)*y\ny'=-y-x+1.e-1*ln(1+x^2)\ninit x=.3\n",
        dict(a=2.0, b=3.0),
        (0.3, 0.0),
        lambda t, y, p: (
            -(y[0] ** 2) - p["a"] / p["b"] * y[0] + (p["a"] ** 0.5) ** p["b"] + y[0] + 2 * (y[0] > 0.1) * y[1],
            -y[1] - y[0] + 0.1 * log(1 + y[0] ** 2),
        ),
        1.0,
    ),
    "wilson_cowan": Published(
        """f(u)=1/(1+exp(-u))
par aee=10,aie=8,aei=12,aii=3,ze=.2,zi=4
par tau=1,i0=.4,w=1.5
drive(t)=i0*sin(w*t)
init u=.1,v=.05
u'=-u+f(aee*u-aie*v-ze+drive(t))
v'=(-v+f(aei*u-aii*v-zi))/tau
""",
        dict(aee=10.0, aie=8.0, aei=12.0, aii=3.0, ze=0.2, zi=4.0, tau=1.0, i0=0.4, w=1.5),
        (0.1, 0.05),
        _wilson_cowan,
        omega=1.5,
    ),
    "duffing": Published(
        "par d=.2,A=.3,omega=1.2\nx'=v\nv'=-d*v+x-x^3+A*cos(omega*t)\ninit x=1\n",
        dict(d=0.2, A=0.3, omega=1.2),
        (1.0, 0.0),
        _duffing,
        omega=1.2,
    ),
    "two_tones": Published(
        "par a=.2,b=.1,per=4\nx'=v\nv'=-.3*v-x+a*sin(2*pi*t/per)+b*cos(6*pi*t/per+1)\n",
        dict(a=0.2, b=0.1, per=4.0),
        (0.0, 0.0),
        _two_tones,
        omega=2 * pi / 4.0,
    ),
    "sawtooth": Published(
        "par a=.5,per=3\nx'=-x+a*mod(t,per)\n",
        dict(a=0.5, per=3.0),
        (0.0,),
        lambda t, y, p: [-y[0] + p["a"] * (t - p["per"] * floor(t / p["per"]))],
        9.0,
        omega=2 * pi / 3.0,
    ),
    "tone_of_numbers": Published(
        "x'=v\nv'=-.2*v-sin(x)+.5*sin(2*t)+.25*cos(3*t-x)\ninit x=.5\n",
        {},
        (0.5, 0.0),
        lambda t, y, p: (y[1], -0.2 * y[1] - sin(y[0]) + 0.5 * sin(2 * t) + 0.25 * cos(3 * t - y[0])),
        omega=1.0,
    ),
    "ring": Published(
        """par om=1,k=.2
x0'=om+k*(sin(x1-x0)+sin(x5-x0))
x[1..4]'=om+k*(sin(x[j+1]-x[j])+sin(x[j-1]-x[j]))
%[5..5]
x[j]'=om+k*(sin(x0-x[j])+sin(x[j-1]-x[j]))
%
init x[0..2]=.5,x3=1
x4(0)=pi/2
""",
        dict(om=1.0, k=0.2),
        (0.5, 0.5, 0.5, 1.0, pi / 2, 0.0),
        _ring,
    ),
    "bump": Published(
        """par a=.3
u[0..7]'=-u[j]+tanh(a*sum(0,7)of(cos(2*pi*([j]-i')/8)*shift(u0,i')))+.1*([j]==3)
init u0=.5
""",
        dict(a=0.3),
        (0.5, *[0.0] * 7),
        _bump,
    ),
    "switched": Published(
        """par a=.5,v0=.1
f(v)=if(v>v0)then(a)else(-a/2)
x'=v
v'=-x-.4*v+f(v)*heav(x)+max(x,v)/10\\
   -min(x,.5)+abs(v)*.01
init x=1
""",
        dict(a=0.5, v0=0.1),
        (1.0, 0.0),
        _switched,
        1.0,
    ),
    "standard_map": Published(
        "par k=.9\np'=p+k*sin(th)\nth'=mod(th+p+k*sin(th),2*pi)\n@ meth=discrete,total=100\ninit p=.1,th=.2\n",
        dict(k=0.9),
        (0.1, 0.2),
        lambda t, y, p: (y[0] + p["k"] * sin(y[1]), (y[1] + y[0] + p["k"] * sin(y[1])) % (2 * pi)),
    ),
    "logistic_map": Published(
        "par r=3.2\nx(t+1)=r*x*(1-x)\nx(0)=.3\n", dict(r=3.2), (0.3,), lambda t, y, p: [p["r"] * y[0] * (1 - y[0])]
    ),
    "stimulus": Published(
        "par s=1.2,tdone=1.5\nv'=-v+s*if(t<tdone)then(t/tdone)else(0)\n", dict(s=1.2, tdone=1.5), (0.0,), _impulse, 3.0
    ),
    "theta": Published(
        "par w1=1.2,w2=.7,beta=.6\nx'= w1+beta*sin(y-x)\ny'= w2+beta*sin(x-y)\ninit x=1.5,y\n"
        "@ fold=x,fold=y,tor_per=6.28318531\n",
        dict(w1=1.2, w2=0.7, beta=0.6),
        (1.5, 0.0),
        lambda t, y, p: (p["w1"] + p["beta"] * sin(y[1] - y[0]), p["w2"] + p["beta"] * sin(y[0] - y[1])),
    ),
}
