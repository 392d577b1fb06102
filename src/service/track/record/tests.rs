use super::*;

#[test]
fn numbers_of_a_vector_are_kept_to_16_bits() {
    let numbers = [0.0, -1.0, 0.5, 1e-3, 0.999];
    let back = vector(&vector_record(&numbers));
    assert_eq!(back.len(), numbers.len());
    for (back, number) in back.iter().zip(numbers) {
        assert!((back - number).abs() < 1e-4, "{back} {number}");
    }
    assert!(vector(&vector_record(&[])).is_empty());
    assert_eq!(vector(&vector_record(&[0.0; 3])), [0.0; 3]);
}

#[test]
fn a_step_is_kept_as_it_was() {
    let measured = Motion::Measured { metres: 1.5, error: 0.2, speed: 3.0 };
    let elapsed = |novelty| Motion::Elapsed { time: 2.0, novelty };
    for motion in [Some(measured), Some(elapsed(None)), Some(elapsed(Some(0.3))), None] {
        let before = Step { frame: 7, motion, max_speed: 10.0 };
        assert_eq!(step(&step_record(&before)), before);
    }
}
