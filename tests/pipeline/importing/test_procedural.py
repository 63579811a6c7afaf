"""Files of AUTO and MatCont: their equations, names, values and refusals."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest

from magpend_core.models import load_model
from magpend_core.models.text.numeric import rates_of
from pipeline.importing.importing import import_file
from pipeline.specification.problems import SpecError

AB_F90 = """!  the A -> B reaction
SUBROUTINE FUNC(NDIM,U,ICP,PAR,IJAC,F,DFDU,DFDP)
  IMPLICIT NONE
  INTEGER, INTENT(IN) :: NDIM, ICP(*), IJAC
  DOUBLE PRECISION, INTENT(IN) :: U(NDIM), PAR(*)
  DOUBLE PRECISION, INTENT(OUT) :: F(NDIM)
  DOUBLE PRECISION X,E
  X=U(1)
  E=DEXP(U(2))   ! Arrhenius
  F(1)=-X + PAR(1)*(1.D0-X)*E
  F(2)=-U(2) + PAR(1)*PAR(2)*(1-x)*E &
       - PAR(3)*U(2)**2**0.5
  IF(IJAC.EQ.0)RETURN
  DFDU(1,1)=-1 - PAR(1)*E
END SUBROUTINE FUNC

SUBROUTINE STPNT(NDIM,U,PAR,T)
  DOUBLE PRECISION, INTENT(INOUT) :: U(NDIM),PAR(*)
  PAR(1)=0.12D0; PAR(2)=14.0
  PAR(3)=2.0
  U(1)=0.01
  U(2)=2*PAR(1)
END SUBROUTINE STPNT
"""
AB_F = """C     the A -> B reaction, fixed form
      SUBROUTINE FUNC(NDIM,U,ICP,PAR,IJAC,F,DFDU,DFDP)
      IMPLICIT DOUBLE PRECISION (A-H,O-Z)
      DIMENSION U(NDIM),PAR(*),F(NDIM)
      X=U(1)
      E=EXP(U(2))
      F(1)=-X + PAR(1)*(1-X)*E
      F(2)=-U(2) + PAR(1)*PAR(2)*(1-X)*E
     * - PAR(3)*U(2)**2**0.5
      RETURN
      END
      SUBROUTINE STPNT(NDIM,U,PAR,T)
      PAR(1)=0.12
      PAR(2)=14.0
      PAR(3)=2.0
      U(1)=0.01
      U(2)=0.24
      END
"""
AB_C = """#include "auto_f2c.h"
/* the A -> B reaction;
   f[0] = 1; */
int func (integer ndim, const doublereal *u, const integer *icp,
          const doublereal *par, integer ijac, doublereal *f, doublereal *dfdu, doublereal *dfdp) {
  doublereal x, e; // a state and a rate
  x = u[0];
  e = exp(u[1]);
  f[0] = -x + par[0]*(1.0 - x)*e;
  f[1] = -u[1] + par[0]*par[1]*(1 - x)*e - par[2]*pow(u[1], pow(2.0, 0.5));
  return 0;
}
int stpnt (integer ndim, doublereal t, doublereal *u, doublereal *par) {
  par[0] = 0.12; par[1] = 14.; par[2] = 2.;
  u[0] = 0.01; u[1] = 2*par[0];
  return 0;
}
"""
AB_M = """function out = ab
out{1} = @init;
out{2} = @fun_eval;
% --------------------------------------------------------------------------
function dydt = fun_eval(t,kmrgd,par_k,par_B,par_c)
x = kmrgd(1);
e = exp(kmrgd(2));  % Arrhenius
dydt=[-x + par_k*(1-x)*e;
-kmrgd(2) + par_k*par_B*(1-x)*e ...
  - par_c*kmrgd(2).^2^0.5;];
% --------------------------------------------------------------------------
function [tspan,y0,options] = init
handles = feval(ab);
y0=[0.01,0.24];
tspan = [0 10];
"""


def wanted(x, y, a, b, c, *, from_left=False):
    e = exp(y)
    return (-x + a * (1 - x) * e, -y + a * b * (1 - x) * e - c * ((y**2) ** 0.5 if from_left else y ** (2**0.5)))


@pytest.mark.parametrize(
    ("name", "text", "from_left"),
    [("ab.f90", AB_F90, False), ("ab.f", AB_F, False), ("ab.c", AB_C, False), ("ab.m", AB_M, True)],
)
def test_read__has_the_equations_of_the_file(tmp_path, name, text, from_left):
    (tmp_path / name).write_text(text)
    found = import_file(tmp_path / name)
    definition = load_model(found.spec.reference).definition
    states = [s.name for s in definition.states]
    assert states == ["x" if name != "ab.f90" else "X", "u2"] or states == ["x", "u2"]
    parameters = [p.name for p in definition.parameters]
    assert parameters == (["k", "B", "c"] if from_left else ["par1", "par2", "par3"])
    values = [definition.presets[0].values[p] for p in parameters]
    assert values == ([1.0, 1.0, 1.0] if from_left else [0.12, 14.0, 2.0])
    assert found.spec.tables["initial_conditions"]["points"] == [[0.01, pytest.approx(0.24)]]
    for x, y in np.random.default_rng(0).uniform(0.1, 1.0, (10, 2)):
        rates = rates_of(definition, {**dict(zip(states + parameters, [x, y, *values], strict=True)), "pi": np.pi})
        assert [float(rates[s]) for s in states] == pytest.approx(wanted(x, y, *values, from_left=from_left), rel=1e-13)


def test_read__parameters_without_values_are_told(tmp_path):
    (tmp_path / "ab.m").write_text(AB_M)
    assert import_file(tmp_path / "ab.m").notes == (
        "the file has no values of k, B, c: 1 stands for each; give your own.",
    )


def test_read__assigned_again_is_another_part(tmp_path):
    (tmp_path / "own.m").write_text(
        "function dydt = f(t, y, a)\ns = y(1);\nr = s + a; r = r*r;\n"
        "dydt = zeros(2,1);\ndydt(1) = r;\ndydt(2) = -r + cos(t);\n"
    )
    found = import_file(tmp_path / "own.m")
    table = load_model(found.spec.reference).definition.table
    assert table["define"] == {"r": "s + a", "r_": "r*r"}
    assert table["equations"] == {"s": "r_", "u2": "-r_ + cos(omega*t)"}


@pytest.mark.parametrize(
    ("name", "old", "new", "problem"),
    [
        ("ab.f90", "PAR(3)*U(2)", "1/3*U(2)", "line 11: 1/3 divides whole numbers, which drops the rest"),
        ("ab.f90", "E=DEXP(U(2))", "DO I=1,2", "line 9: 'DO I=1,2': only assignments are read"),
        ("ab.f90", "SUBROUTINE FUNC", "SUBROUTINE FANC", "line 1: there is no routine FUNC"),
        ("ab.f90", "F(1)=", "F(3)=", "line 1: there is no equation of variable 1"),
        ("ab.f90", "DEXP(", "BESSEL(", "line 9: bessel: the text of a model has no such function"),
        ("ab.c", "x = u[0];", "if (ijac) x = u[0];", "line 7: 'if (ijac) x = u[0]': only assignments are read"),
        ("ab.c", "e = exp(u[1])", "e = fmod(u[1], 2.0)", "line 8: fmod of C: the text of a model has no such function"),
        ("ab.c", "x = u[0];", "x = u[ndim];", "line 7: u must have a number as its index"),
        ("ab.m", "x = kmrgd(1);", "for i = 1:3, x = kmrgd(1); end", "line 6: 'for i = 1:3, x = kmrgd(1)'"),
        ("ab.m", "function dydt = fun_eval(t,kmrgd,", "function fun_val(", "line 1: there is no function dydt"),
        ("ab.m", "exp(kmrgd(2))", "expm(kmrgd(2))", "line 7: expm: the text of a model has no such function"),
    ],
)
def test_read__refuses_with_line_and_reason(tmp_path, name, old, new, problem):
    text = {"ab.f90": AB_F90, "ab.c": AB_C, "ab.m": AB_M}[name]
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new))
    with pytest.raises(SpecError) as caught:
        import_file(tmp_path / name)
    assert any(problem in one for one in caught.value.problems), caught.value.problems
